"""How a flat configuration becomes a data set and its options, also one that an earlier version wrote."""

import pytest

from ghgs_lit.data.datamodules import HuMManDataModule, RenderedDataModule
from ghgs_lit.data.layout import Rendered
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis.datamodules import SyntheticDataModule
from tests.helpers.people import RELEASE, V4


def test_flat_keys_are_divided_among_data_set_and_options():
    """Documented commands set data.root and data.batch_size side by side; each reaches its owner."""
    data = RenderedDataModule(V4, RELEASE, root="x", size=28, batch_size=3, limit={"val": 2}, workers=1)
    assert data.dataset == Rendered(root="x", limit={"val": 2})
    assert data.dataset.limit == {"train": None, "val": 2}
    assert (data.options.size, data.options.target_size) == ((28, 28), (28, 28))
    assert (data.options.batch_size, data.options.workers) == (3, 1)


@pytest.mark.parametrize(
    ("module", "key", "line"),
    [
        (
            RenderedDataModule,
            "batchsize",
            r"RenderedDataModule; found 'batchsize' .did you mean batch_size",
        ),
        (
            HuMManDataModule,
            "smpl_modell",
            r"HuMManDataModule; found 'smpl_modell' .did you mean smpl_model",
        ),
        (HuMManDataModule, "pixel_centers", r"HuMManDataModule; found 'pixel_centers'"),
        (SyntheticDataModule, "root", r"SyntheticDataModule; found 'root'"),
    ],
)
def test_a_wrong_key_names_the_class_and_the_key(module, key, line):
    """A misspelt key must never be swallowed."""
    with pytest.raises(InputError, match=f"data key: expected one of (active, )?apply_mask, .* for {line}"):
        module(V4, RELEASE, size=28, **{key: 1})


def test_evaluation_takes_protocols_and_no_bare_names(tmp_path):
    """A name alone would ignore the file of the protocol in conf/targets."""
    with pytest.raises(InputError, match="targets: expected a mapping of the settings of TargetProtocol"):
        RenderedDataModule(V4, RELEASE, root=str(tmp_path), size=28).evaluation_loader(targets="midway")
