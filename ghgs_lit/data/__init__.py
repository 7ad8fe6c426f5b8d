"""Data sets of people: reading, sampling, augmentation and batching of images."""
