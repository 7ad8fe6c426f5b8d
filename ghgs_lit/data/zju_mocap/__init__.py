"""ZJU-MoCap: one performer among 21 or 23 cameras, read as it is downloaded."""
