"""Published weights: their names, reading and writing them, import from the releases and export back."""
