"""Small data sets of built-in people in published layouts, to try loaders without the real data."""
