"""Small data sets of built-in people in the published layouts, to try a loader without the real data."""
