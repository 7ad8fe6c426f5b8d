"""Paths, config groups, keys and names in the documents exist, and their fast commands run."""

import importlib.util
import pydoc
import re
import sys
import tomllib
from functools import lru_cache
from itertools import zip_longest
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from ghgs_lit.config import compose, run_of
from ghgs_lit.method.bounds.box import MARGIN
from ghgs_lit.method.heads.attributes import OPACITY_START, SCALE_CAP
from ghgs_lit.runs.results import read_results
from tests.helpers.processes import run_block, run_script, run_verb

REPOSITORY = Path(__file__).resolve().parents[1]
CONF = REPOSITORY / "conf"
VERBS = (
    "adapt",
    "train",
    "pretext",
    "evaluate",
    "predict",
    "prepare",
    "benchmark",
    "stress",
    "table",
    "import",
    "export",
    "view",
    "doctor",
)
# Files that readers create, and options and names that are not in this repository.
MADE = ("conf/data/my_people.yaml", "conf/sweep/<name>.yaml")
OPTIONS = {
    "ablation": {"one_neighbor", "residual", "shuffled", "relative"},
    "sweep": {"controls"},
    "data": {"my_people"},
    "model": {"gps"},
    "hydra/launcher": {"joblib", "submitit_local"},
}
# a group of entry points, and a file format
NO_MODULES = {"ghgs_lit.plugins"}


def _script(name: str):
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module
    spec.loader.exec_module(module)
    return module


check_documents = _script("check_documents")
DOCUMENTS = check_documents.documents()


def code(document: str) -> list[str]:
    """Code of a document, each span on one line: inline code, and blocks in languages other than Python."""
    text = (REPOSITORY / document).read_text()
    named = re.findall(r"^```(\w*)\n(.*?)^```", text, re.M | re.S)
    blocks = [block for language, block in named if language != "python"]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    # commands that once produced a table
    prose = re.sub(r"`[^`]*` of commit \w+", "", prose)
    return [" ".join(s.split()) for s in [*re.findall(r"(?<!`)`([^`]+)`(?!`)", prose), *blocks]]


@lru_cache
def groups() -> dict[str, set[str]]:
    """Options of each config group, such as ``bounds: box, hull, none``."""
    found: dict[str, set[str]] = {}
    for path in CONF.rglob("*.yaml"):
        group = path.parent.relative_to(CONF).as_posix()
        found.setdefault(group, set(OPTIONS.get(group, ()))).add(path.stem)
    found.pop(".")
    return found


@lru_cache
def keys() -> frozenset[str]:
    """Dotted keys of all verbs and of every option of every group, including inner nodes."""
    found: set[str] = set()

    def collect(node: object, prefix: str = "") -> None:
        for name, value in node.items() if isinstance(node, dict) else ():
            found.add(f"{prefix}{name}")
            collect(value, f"{prefix}{name}.")

    shipped = [
        [f"{group}={option}" for option in sorted(options - OPTIONS.get(group, set()))]
        for group, options in groups().items()
        if "/" not in group and group not in ("experiment", "sweep", "calibration")
    ]
    # One option per group in each run, because composing takes a third of a second.
    runs = [(verb, []) for verb in VERBS]
    runs += [("train", [*filter(None, chosen)]) for chosen in zip_longest(*shipped)]
    runs.append(("train", ["feature_cache.kind=disk"]))
    for verb, overrides in runs:
        collect(OmegaConf.to_container(compose(verb, overrides), resolve=False))
    return frozenset(found)


def is_key(name: str) -> bool:
    """Whether a verb has the key; a document may omit its beginning."""
    return name in keys() or any(key.endswith(f".{name}") for key in keys())


def _missing_paths(document: str) -> list[str]:
    text, folder = (REPOSITORY / document).read_text(), (REPOSITORY / document).parent
    links = {t.split("#")[0] for t in re.findall(r"\]\(([^)\s]+)\)", text) if not t.startswith("http")}
    missing = [link for link in links if link and not (folder / link).exists()]
    rooms = r"(?<![\w/.])((?:ghgs_lit|conf|docs|scripts|tests|benchmarks)/[\w./<>-]*)"
    named = {path.rstrip("/.") for span in code(document) for path in re.findall(rooms, span)}
    missing += [p for p in named if "<" not in p and p not in MADE and not (REPOSITORY / p).exists()]
    return missing


def test_paths_exist():
    """Links and paths in the documents must not refer to moved files."""
    missing = {document: _missing_paths(document) for document in DOCUMENTS}
    assert not any(missing.values()), missing


def test_example_of_a_head_is_the_file():
    """The guide prints the whole of ``examples/linear_depth.py``, which its command trains."""
    code = (REPOSITORY / "examples" / "linear_depth.py").read_text().partition("\n\n")[2]
    assert f"```python\n{code}```" in (REPOSITORY / "docs" / "extend.md").read_text()


def test_packages_exist():
    """The tables in CONTRIBUTING name existing folders and files of the package."""
    cells = re.findall(r"^\|(.+)\|$", (REPOSITORY / "CONTRIBUTING.md").read_text(), re.M)
    named = {n for cell in cells for n in re.findall(r"`([\w/]+\.(?:py|yaml)|[\w/]+/)`", cell)}
    named |= {n for cell in cells for n in re.findall(r"`(\w+)`", cell.split("|")[0])}
    assert len(named) > 20
    assert not [n for n in named if not any((REPOSITORY / root / n).exists() for root in ("ghgs_lit", "."))]


def test_names_of_the_package_exist():
    """Names such as ``ghgs_lit.data.reader.Reader`` must be importable, also in Python blocks."""
    text = "\n".join((REPOSITORY / document).read_text() for document in DOCUMENTS)
    named = {name.rstrip(".") for name in re.findall(r"(?<![\w/])ghgs_lit(?:\.[A-Za-z]\w*)+", text)}
    assert not [name for name in named - NO_MODULES if pydoc.locate(name) is None]


def test_options_and_keys_exist():
    """Each ``group=option`` is a file of ``conf`` or ``--config-dir``, each ``key=value`` a key of a
    verb."""
    wrong = []
    for span in (span for document in DOCUMENTS for span in code(document)):
        # Python values in calls are not configuration values
        for name, value in re.findall(r"(?<![\w.$<{+/-])([a-z][\w./]*)=([^\s'`]*)", span):
            if name in groups():
                options = re.findall(r"[a-z]\w*", value) if re.match(r"[a-z]", value) else []
                known = groups()[name] | {"null"}
                for folder in re.findall(r"--config-dir (\S+)", span):
                    known |= {file.stem for file in (REPOSITORY / folder / name).glob("*.yaml")}
                wrong += [f"{name}={option}" for option in options if option not in known]
            elif not re.match(r"True|False|\(", value) and not name.startswith("hydra.") and not is_key(name):
                wrong.append(f"{name}={value}")
        dotted = re.fullmatch(r"([a-z_]+)(?:\.[a-z_]+)+", span)
        is_file = re.search(r"\.(json|jsonl|csv|md|py|yaml|npy|npz|pth|pt|ckpt|db|ply|txt|png|tex)$", span)
        if dotted and not is_file and dotted[1] in keys() and not is_key(span):
            wrong.append(span)
    assert not wrong


def test_figures_are_of_todays_weights_and_people():
    assert [fault for document in DOCUMENTS for fault in check_documents.stale_figures(document)] == []


@pytest.mark.parametrize(
    ("document", "change", "expected"),
    [
        ("README.md", {}, []),
        ("README.md", {"weights WEIGHTS": "weights none"}, []),
        ("README.md", {"weights WEIGHTS": "weights da9733ed32f3"}, ["weights"]),
        ("README.md", {"people PEOPLE": "people 1", "Text": "Older people"}, ["people"]),
        ("docs/evidence/a.md", {"people PEOPLE": "people 1"}, ["people"]),
        ("docs/evidence/a.md", {"people PEOPLE": "people 1", "Text": "Older people"}, []),
        ("README.md", {"HEAD": "abcdef12"}, ["abcdef12"]),
        ("README.md", {"<!--": "<!-- no"}, ["expected `<!-- figures"]),
        ("README.md", {"-->\n": "-->\n# Next\n"}, ["expected `<!-- figures"]),
    ],
)
def test_stale_figures_are_found(document, change, expected, tmp_path, monkeypatch):
    text = "# A\nText\n\n<!-- figures: ghgs evaluate; commit HEAD; weights WEIGHTS; people PEOPLE -->\n"
    text += "| a | b |\n|---|---|\n| 1.5 | **2.5** |\n| -3.5 | 4.5 / 5.5 |\n"
    for old, new in change.items():
        text = text.replace(old, new)
    for kind, today in check_documents.TODAY.items():
        text = text.replace(kind.upper(), today)
    (tmp_path / document).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / document).write_text(text)
    monkeypatch.setattr(check_documents, "ROOT", tmp_path)
    monkeypatch.setattr(check_documents, "HISTORY", "0123456789\n")
    faults = check_documents.stale_figures(document)
    assert len(faults) == len(expected)
    assert all(part in fault for part, fault in zip(expected, faults, strict=True))


def test_promised_pythons_agree():
    """README, package, linter and the script that tests them state the same versions of Python."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    oldest, last = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["project"]["requires-python"]).groups()
    versions = [f"3.{minor}" for minor in range(int(oldest), int(last))]
    classifiers = " ".join(project["project"]["classifiers"])
    assert re.findall(r"Python :: (3\.\d+)", classifiers) == versions
    assert project["tool"]["ruff"]["target-version"] == f"py{versions[0].replace('.', '')}"
    assert f"Python {versions[0]} to {versions[-1]} on" in (REPOSITORY / "README.md").read_text()
    assert f"{versions[0]} {versions[-1]}" in (REPOSITORY / "scripts" / "test_pythons.sh").read_text()
    markers = re.findall(r"python_version . \W3\.(\d+)", (REPOSITORY / "constraints.txt").read_text())
    # no pins for unsupported versions
    assert all(int(oldest) < int(minor) for minor in markers)


def test_commands_are_read_whole(tmp_path, monkeypatch):
    """Continuation lines, comments, Python blocks and commands in running text are all found."""
    text = "`ghgs table\nruns=x` `ghgs table`\n```bash\n# no\nghgs train a=1 \\\n    'b=#2'  # yes\n```\n"
    (tmp_path / "a.md").write_text(f"{text}```python\nx = 1\ny = 2\n```\n")
    monkeypatch.setattr(check_documents, "ROOT", tmp_path)
    found = check_documents.commands("a.md")
    assert [(c.line, c.text) for c in found] == [
        (1, "ghgs table runs=x"),
        (5, "ghgs train a=1 'b=#2'"),
        (9, "x = 1\ny = 2\n"),
    ]


def test_commands_for_a_gpu_are_run_on_a_cpu():
    """Wrong or missing keys are found without a GPU; README's command is among those of every test run."""
    found = [
        c for document in DOCUMENTS for c in check_documents.commands(document) if "trainer=gpu" in c.text
    ]
    assert [c.text for c in found if c.reason is not None] == []
    assert all("trainer=gpu" not in c.script()[0] and "trainer=cpu" in c.script()[0] for c in found)
    assert any(c.is_fast for c in found if c.document == "README.md")


def test_a_command_that_fails_is_reported(tmp_path, monkeypatch, capsys):
    """A script that hides failures would pass every document."""
    (tmp_path / "README.md").write_text("```bash\ntrue\nghgs no_such_verb\n```\n")
    monkeypatch.setattr(check_documents, "ROOT", tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    assert check_documents.main(["README.md", "--folder", str(tmp_path / "out")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("ran ")
    assert lines[1].startswith("FAILED ")
    assert lines[-1] == "1 ran, 1 failed, 0 not run"


@pytest.mark.parametrize("document", check_documents.FAST)
def test_fast_commands_run(document, tmp_path, monkeypatch):
    """Commands that take seconds run as printed (all commands: `make documents`)."""
    run = check_documents.Reader.run

    def prepared(reader, text, is_python=False):
        """Run a single verb or script, or Python, in a process that has imported everything, without a
        shell."""
        if not is_python and (
            not re.match(r"ghgs |python scripts/", text) or re.search(r"[$`|&;<>*\n]", text)
        ):
            return run(reader, text)
        run_prepared = run_block if is_python else run_verb if text.startswith("ghgs ") else run_script
        code, output = run_prepared(text, reader.folder, reader.environment)
        return code, 0.0, output

    monkeypatch.setattr(check_documents.Reader, "run", prepared)
    assert check_documents.main(["--fast", document, "--folder", str(tmp_path)]) == 0


#: Decibels by which a figure may differ on another processor: two units of the last printed digit.
ROUNDING = 0.02


def figures(document: str) -> dict[tuple[str, str], list[tuple[float, float]]]:
    """PSNR and PSNR of the box in the tables of a document, by the first two columns."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for first, second, *numbers in re.findall(
        r"^\| (\w+) \| (\w+) \| ([\d.]+) \| ([\d.]+) \|", document, re.M
    ):
        found.setdefault((first, second), []).append(tuple(map(float, numbers)))
    return found


def test_figures_of_the_first_day_are_those_of_a_run(tmp_path):
    """Untrained methods, evaluated again on the people that the page holds out, have the printed figures.

    The page's model has the same figures in both tables, and is as far below perfect depth as stated.
    """
    page = (REPOSITORY / "docs" / "first_day.md").read_text()
    printed, reader = figures(page), check_documents.Reader(tmp_path, "docs/first_day.md")
    for command in (
        "python scripts/miniature.py data=thuman2 data.source=my_scans --train 1",
        "ghgs prepare task=render data=scans data.source=my_scans data.root=rendered data.render.size=140",
        "ghgs evaluate data=scans data.root=rendered 'evaluation.views=[4]' "
        "'baselines=[nearest_view,true_depth]' hydra.run.dir=measured",
    ):
        run = run_verb if command.startswith("ghgs ") else run_script
        code, output = run(command, reader.folder, reader.environment)
        assert code == 0, output
    summary = read_results(reader.folder / "measured" / "metrics.json")["summary"]
    assert len(summary) == 4
    for row in summary:
        (expected,) = printed[row["method"], row["targets"]]
        assert (row["psnr"], row["psnr_box"]) == pytest.approx(expected, abs=ROUNDING)
    for targets in ("release", "midway"):
        (trained,), (again,) = printed["4", targets], printed["model", targets]
        ((perfect, _),) = printed["true_depth", targets]
        assert trained == again
        assert f"{perfect - trained[0]:.2f} dB" in page


def test_the_page_prints_the_figures_of_the_code():
    text = (Path(__file__).parents[1] / "docs" / "method.md").read_text()
    run = run_of("train", ["experiment=thuman2", "data.root=x"]).plain
    head, recalibration, optimizer = run["gaussian_head"], run["recalibration"], run["optimizer"]
    attributes = head["attributes"]
    figures = [
        f"at most {100 * head['offset_limit']:g} cm",
        f"{attributes['scale_floor']} to {SCALE_CAP:g} footprints",
        f"at first {attributes['scale_start']} ",
        f"at least {attributes['opacity_floor']}, at first {OPACITY_START} ",
        f"{recalibration['k']} (`recalibration.k`)",
        f"{recalibration['num_heads']} heads",
        f"layers {', '.join(map(str, run['encoder']['layers']))} ",
        f"(`bounds.kind={run['bounds']['kind']}`, margin {100 * MARGIN:g} cm)",
        f"`encoder.trainable={run['encoder']['trainable']}`",
        f"`recalibration.tokens={recalibration['tokens']}`",
        f"weight decay {optimizer['weight_decay']:.0e}".replace("e-0", "e-"),
        f"{run['data']['size']} x {run['data']['size']} (HuMMan 360 x 640)",
    ]
    assert [figure for figure in figures if figure not in text] == []
