"""The DataModules of the data sets that can be rendered: the kinds of ``conf/data``."""

from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.synthesis.datasets import Scans, Synthetic
from ghgs_lit.synthesis.thuman2 import THuman2


class ScansDataModule(PhotographsDataModule):
    """Batches of :class:`Scans`."""

    dataset_type = Scans


class SyntheticDataModule(PhotographsDataModule):
    """Batches of :class:`Synthetic`."""

    dataset_type = Synthetic


class THuman2DataModule(PhotographsDataModule):
    """Batches of :class:`THuman2`."""

    dataset_type = THuman2
