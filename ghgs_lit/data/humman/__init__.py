"""HuMMan-Recon v1.0: one performer among ten Kinects, read as it is downloaded."""
