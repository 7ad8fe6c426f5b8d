"""Reader of HuMMan-Recon v1.0 as downloaded: one performer among ten Kinects."""
