"""ZJU-MoCap: one performer among 21 or 23 cameras, as it is downloaded."""

from ghgs_lit.data.zju_mocap.datamodule import ZJUMoCapDataModule

__all__ = ["ZJUMoCapDataModule"]
