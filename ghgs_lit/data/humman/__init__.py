"""HuMMan-Recon v1.0: one performer among ten Kinects, as it is downloaded."""

from ghgs_lit.data.humman.datamodule import HuMManDataModule

__all__ = ["HuMManDataModule"]
