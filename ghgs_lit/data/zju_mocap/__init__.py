"""Reader of ZJU-MoCap as downloaded: one performer among 21 or 23 cameras."""
