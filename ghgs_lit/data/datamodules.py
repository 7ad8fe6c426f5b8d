"""The DataModules of the data sets that are read as they are: the kinds of ``conf/data``."""

from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.humman.dataset import HuMMan
from ghgs_lit.data.layout import Rendered
from ghgs_lit.data.zju_mocap.dataset import ZJUMoCap


class HuMManDataModule(PhotographsDataModule):
    """Batches of :class:`HuMMan`."""

    dataset_type = HuMMan


class RenderedDataModule(PhotographsDataModule):
    """Batches of :class:`Rendered`."""

    dataset_type = Rendered


class ZJUMoCapDataModule(PhotographsDataModule):
    """Batches of :class:`ZJUMoCap`."""

    dataset_type = ZJUMoCap
