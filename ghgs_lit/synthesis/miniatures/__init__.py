"""Small data sets in the published layouts, made of built-in people: to try a loader without the data."""
