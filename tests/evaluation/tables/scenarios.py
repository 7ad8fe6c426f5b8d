"""Runs and options of the tables whose expected text is in ``tests/fixtures/tables``."""

from typing import Any

from tests.helpers.tables import SWITCHES

PEOPLE = {f"s{i:02d}": 0.1 * i for i in range(12)}


def people(number: int) -> dict[str, float]:
    """Values of 12 subjects, which vary slightly from run to run."""
    return {name: value + 0.01 * (i * (number + 3) % 7 - 3) for i, (name, value) in enumerate(PEOPLE.items())}


def seeds(row: str, *values: float, **about: Any) -> list[tuple]:
    """A run for each seed from 1 on."""
    return [(row, value, {"seed": seed, **about}) for seed, value in enumerate(values, 1)]


def noisy(row: str, *values: float, start: int = 1, **about: Any) -> list[tuple]:
    """A run for each seed from ``start`` on, with many subjects."""
    runs = []
    for seed, value in enumerate(values, start):
        runs.append((row, value, {"seed": seed, "views": (4,), "shifts": people(int(10 * value)), **about}))
    return runs


def views(*counts: int) -> dict[str, Any]:
    return {"training_counts": list(counts), "training": "any", "evaluation_count": counts[0]}


def chosen(ablation: str, model: str = "paper", **sets: Any) -> dict[str, Any]:
    keys = {key.replace("__", "."): value for key, value in sets.items()}
    return {"model": model, "encoder": "vggt_nano", "ablation": ablation, "sets": keys}


def neighbors(k: int, **changes: str) -> dict[str, Any]:
    return {"neighborhood": "xyz", "similarity": "product", "k": k, **changes}


WEIGHTS = {"weights": "vggt.safetensors"}
HULL = {"name": "hull"}
FRAMES = {f"p{i // 5}_{i % 5:03d}": 0.3 * (i * 7 % 11) for i in range(20)}
#: One run each: row (ablation), PSNR (None: no results yet), and further arguments of ``write_run``.
RUNS: dict[str, list[tuple]] = {
    "mixed": [
        *seeds("full", 20.0, 21.0, None),
        ("no_semantic", 21.0, {"views": (4,)}),
        ("no_semantic", None, {"seed": 2, "evaluation": {"views": [5]}}),
        ("no_unprojection", 19.0, {}),
        ("neither", None, {"seed": 2}),
    ],
    "within": [
        *seeds("full", 19.9, 20.9, 21.9),
        *seeds("neither", 19.75, 20.0, 20.25),
        *seeds("no_semantic", 5.0, 10.0, 15.0),
    ],
    "beyond": [*seeds("full", 20.2, 21.2, 22.2), *seeds("neither", 19.75, 20.0, 20.25)],
    "lower": [("full", 20.0, {"metrics": {"lpips": 0.05}}), ("neither", 20.0, {"metrics": {"lpips": 0.06}})],
    "identity": [
        ("full", 20.0, {}),
        ("full", 20.0, {"measured": {}}),
        ("no_semantic", 20.0, {"seed": 7, "measured": {}}),
        (
            "neither",
            19.0,
            {
                "measured": {},
                "provenance": {
                    "model_config": {"recalibration": {"neighborhood": "xyz", "similarity": "none"}}
                },
            },
        ),
        (
            "full",
            18.0,
            {
                "recalibration": {"neighborhood": "image_plane", "similarity": "log"},
                "ablation": {"name": "full", "unprojection": True, "semantic": True},
            },
        ),
    ],
    "lpips": [("full", 20.0, {"metrics": {"lpips": 0.05}, "encoder": WEIGHTS})],
    "flip": [
        ("full", 20.0, {"metrics": {"lpips": 0.05}, "encoder": WEIGHTS}),
        ("neither", 20.0, {"encoder": WEIGHTS}),
    ],
    "branch": [("full", 20.0, {"encoder": {"semantic": {"width": 64}, "weights": "pretext"}})],
    "random_branch": [("full", 20.0, {"encoder": {"semantic": {"width": 64}, "weights": None}})],
    "notes": [
        ("full", 20.0, {"provenance": {"git": {"commit": "a" * 40, "changed": False}}}),
        (
            "neither",
            20.0,
            {"provenance": {"git": {"commit": "b" * 40, "changed": True}}, "optimizer": {"lr": 0.1}},
        ),
    ],
    "settings": [
        ("full", 20.0, {}),
        ("full", 18.0, {"targets": "midway"}),
        ("full", 18.0, {"protocol": "release"}),
    ],
    "rates": [("full", 20.0, {"optimizer": {"lr": 0.1}}), ("full", 21.0, {"optimizer": {"lr": 0.2}})],
    "rates_of_seeds": [
        ("full", 20.0, {"optimizer": {"lr": 0.1}}),
        ("full", 21.0, {"seed": 2, "optimizer": {"lr": 0.2}}),
    ],
    "same_numbers": [
        ("full", 20.0, {"recalibration": neighbors(64)}),
        ("full", 20.0, {"recalibration": neighbors(1)}),
    ],
    "only_ablations": [("neither", 20.0, {})],
    "rivals": [("full", 20.0, {}), ("full", 21.0, {})],
    "checkpoints": [
        ("full", 20.0, {"measured": {"checkpoint": "a.ckpt"}}),
        ("full", 21.0, {"measured": {"checkpoint": "b.ckpt"}}),
        ("full", 22.0, {"seed": 2, "measured": {"checkpoint": "c.ckpt"}}),
    ],
    "refined": [
        ("full", 20.0, {"measured": {"refine": 0, "refine_cameras": 0}}),
        ("full", 21.0, {"measured": {"refine": 15, "refine_cameras": 4}}),
    ],
    "views": [
        ("full", 20.0, {"views": (3, 4), "of_views": views(3)}),
        ("full", 21.0, {"views": (3, 4), "of_views": views(4), "seed": 2}),
        ("full", 22.0, {"views": (3, 4), "of_views": views(4)}),
        ("full", None, {"of_views": views(3), "seed": 2, "evaluation": {"views": [3]}}),
        ("full", None, {"of_views": views(5), "evaluation": {"views": [5]}}),
    ],
    "data_sets": [
        (
            "full",
            20.0,
            {
                "data": "zju_mocap",
                "views": (4,),
                "of_targets": {"name": "cameras", "training_views": [0], "view": 0},
            },
        ),
        (
            "full",
            20.0,
            {"data": "humman", "views": (4,), "of_targets": {"name": "x", "training_views": [2], "view": 1}},
        ),
    ],
    "reported": [("full", 10.0, {"metrics": {"lpips": 0.5}})],
    "other_data": [("full", 10.0, {"views": (4,)}), ("full", None, {"data": "humman"})],
    "models": [
        ("full", 20.0, {}),
        ("full", 21.0, {"model": HULL}),
        ("full", 22.0, {"model": HULL, "compat": {"name": "release"}}),
        ("full", 23.0, {"model": {"name": "gps"}}),
        ("full", 19.0, {"model": {"name": "pixel"}}),
        ("full", 20.5, {"model": HULL, "chosen": chosen("full", "mine")}),
        ("full", 30.0, {"method": "true_depth"}),
        ("full", 12.0, {"method": "nearest_view"}),
    ],
    "odd_names": [
        ("full", 20.0, {"data": "my_data & 50% #1", "model": {"name": "a_b^c"}}),
        ("full", 21.0, {"data": "my_data & 50% #1", "model": {"name": "x~y{z}"}}),
    ],
    "own": [
        *((name, 20.0, {"chosen": chosen(name)}) for name in SWITCHES),
        ("full", 18.0, {"recalibration": neighbors(1), "chosen": chosen("mine", recalibration__k=1)}),
        (
            "full",
            None,
            {
                "recalibration": neighbors(8, similarity="log", neighborhood="feature"),
                "chosen": chosen("log"),
            },
        ),
    ],
    "training": [
        ("full", 20.0, {"provenance": {"training": {"steps": 350, "seconds": 61.4, "peak_bytes": 2.5e9}}}),
        ("neither", 19.0, {"provenance": {"training": {"steps": 350, "seconds": 50.0}}}),
        ("neither", 19.0, {"seed": 2, "provenance": {"training": {"steps": 360}}}),
    ],
    "near": [
        ("full", 20.0, {"metrics": {"shared_neighbors": 0.95}}),
        ("no_unprojection", 20.0, {"metrics": {"shared_neighbors": 0.85}}),
    ],
    "clear": [
        *noisy("full", 20.0, 20.1, 20.2),
        *noisy("neither", 21.0, 21.1, 21.3),
        *noisy("no_semantic", 20.1, 20.1, 20.2),
    ],
    "models_with_seeds": [
        *noisy("full", 20.0, 20.1),
        *noisy("full", 20.2, 20.4, model=HULL),
        *noisy("full", 20.1, 20.3, model={"name": "gps"}),
    ],
    "low": [
        *noisy("full", 20.0, 20.1, metrics={"lpips": 0.2}),
        *noisy("neither", 20.0, 20.3, metrics={"lpips": 0.1}),
    ],
    "frames": [*noisy("full", 20.0, 20.1, shifts=FRAMES), *noisy("neither", 25.0, 25.1, shifts=FRAMES)],
    "one_seed": [*noisy("full", 20.0), *noisy("neither", 25.0)],
    "other_seeds": [*noisy("full", 20.0, 20.0, 20.0), *noisy("neither", 25.0, 25.0, 25.0, start=4)],
}
RUNS["several_views"] = [*RUNS["views"], ("full", 20.0, {"views": (3, 4), "of_views": views(3, 4)})]
RUNS["paper_data"] = [*RUNS["other_data"], ("full", 20.0, {"data": "zju_mocap", "views": (4,)})]

PSNR = {"metrics": ("psnr",)}
OURS = {"layout": "table2", "reported": False, **PSNR}
CLEAR = {"views": (4,), **PSNR}
#: Names of runs and options of each table.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "rows": ("mixed", {}),
    "lead_within_the_deviation": ("within", CLEAR),
    "lead_beyond_the_deviation": ("beyond", CLEAR),
    "lower_is_better": ("lower", {"views": (3,), "metrics": ("lpips", "flip")}),
    "identity": ("identity", CLEAR),
    "lpips": ("lpips", {"views": (3,)}),
    "flip_for_lpips": ("flip", {"views": (3,)}),
    "learned_branch": ("branch", CLEAR),
    "random_branch": ("random_branch", CLEAR),
    "notes": ("notes", {}),
    "settings": ("settings", PSNR),
    "midway": ("settings", {"targets": ("midway",), **PSNR}),
    "by_rate": ("rates", {"by": ("optimizer.lr",), **PSNR}),
    "by_checkpoint": ("checkpoints", {**OURS, "by": ["checkpoint"]}),
    "views": ("views", OURS),
    "views_of_ablations": ("views", PSNR),
    "by_views": ("several_views", {**OURS, "by": ["views.training_counts"]}),
    "data_sets": ("data_sets", {**OURS, "layout": "table1"}),
    "reported": ("reported", {"layout": "table2"}),
    "not_reported": ("reported", {"layout": "table2", "reported": False}),
    "other_data": ("other_data", {"layout": "table1", **PSNR}),
    "paper_data": ("paper_data", {"layout": "table1", **PSNR}),
    "models": ("models", {**OURS, "layout": "table3"}),
    "odd_names": ("odd_names", {**OURS, "layout": "table3"}),
    "own_ablations": ("own", {"layout": "table4", **PSNR}),
    "own_methods": ("own", {**OURS, "layout": "table3"}),
    "by_neighbors": ("same_numbers", {"by": ["recalibration.k"], **CLEAR}),
    "training": ("training", {"views": (4,), "metrics": ("psnr", "steps", "seconds", "peak_gb")}),
    "near": ("near", CLEAR),
    "clear": ("clear", {"views": (4,)}),
    "lowest_is_best": ("low", {"metrics": ("lpips",)}),
    "people": ("frames", {**CLEAR, "unit": r"(p\d)_\d+"}),
    "one_person": ("frames", {**CLEAR, "unit": r"(p)\d_\d+"}),
    "one_seed": ("one_seed", CLEAR),
    "other_seeds": ("other_seeds", CLEAR),
}
CONFIGURATION = "one configuration, and one run a seed, for ablation=full, .*"
#: Names of runs and options that are rejected, with the message.
REFUSED: list[tuple[str, dict[str, Any], str]] = [
    (
        "rates",
        {},
        r"full, 3 views; found .*0/metrics\.json and .*1/metrics.json.*by=\[optimizer\.lr\]",
    ),
    ("rates_of_seeds", {}, CONFIGURATION + r"optimizer.lr` \(0.1, 0.2\): by=\[optimizer.lr\]"),
    ("same_numbers", {}, CONFIGURATION + r"recalibration.k` \(64, 1\): by=\[recalibration.k\]"),
    ("rivals", {}, "their configurations are equal; runs="),
    ("checkpoints", {}, r"0/metrics.json and .*1/metrics.json.*by=\[checkpoint\]"),
    ("refined", {}, r"by=\[refine,refine_cameras\]"),
    ("several_views", OURS, r"\(\[3\], \[3, 4\]\): by=\[views.training_counts\]"),
    ("checkpoints", {"by": ["chekpoint"]}, "by: expected keys of the runs' configurations; .*'chekpoint'"),
    ("settings", {"targets": ("random",)}, r"evaluation\.targets: expected some of release, midway.*random"),
    ("mixed", {"views": (7,)}, r"evaluation\.views: expected some of 3, 4, 5, .*7"),
    ("near", {"metrics": ("psnr_bx",)}, "columns: .* psnr, ssim, flip, shared_neighbors; found 'psnr_bx'"),
    ("rivals", {**OURS, "views": (9,)}, r"evaluation\.views: expected some of 3, 4, 5"),
    ("only_ablations", OURS, "runs of layout=table2; found .baselines or the paper"),
    ("frames", {**CLEAR, "unit": "p"}, "unit: expected a regular expression with a group; found"),
    ("frames", {**CLEAR, "unit": "("}, "unit: expected a regular expression with a group; found"),
]
