"""Near and far of each pixel, from masks and cameras."""
