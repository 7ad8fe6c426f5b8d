"""The verbs and the text of ``ghgs --help``."""

_LISTED = """\
  prepare   render scans into training data, or make the built-in people
              ghgs prepare task=render data=scans data.source=scans data.root=rendered
  train     train a model (model=hull; the paper's method: model=paper) and evaluate it
              ghgs train model=hull data=synthetic trainer.max_time=00:00:10:00
  pretext   train the semantic branch of an encoder on the parts of built-in people
              ghgs pretext data=synthetic data/rig=varied trainer.max_time=00:00:15:00
  adapt     train the weights of the package further for your own cameras, in minutes
              ghgs adapt cameras=cameras.json images=photographs masks=masks out=mine.ckpt
  evaluate  measure a checkpoint or the baselines
              ghgs evaluate checkpoint=runs/train/.../checkpoints/last.ckpt
  predict   turn photographs into a splat, pictures and a page
              ghgs predict checkpoint=last.ckpt images=photographs cameras=cameras.json masks=masks out=splat
  doctor    whether cameras and masks fit together, what this machine lacks, whether a GPU computes well
              ghgs doctor task=cameras images=photographs cameras=cameras.json masks=masks
  view      a page in the browser to look around in a prediction
              ghgs view path=runs/predict/...
  import    published weights to a checkpoint
              ghgs import vggt=facebook/VGGT-1B release=release.pth out=release.ckpt
  export    a checkpoint to a small one for prediction, or to the published names
              ghgs export checkpoint=checkpoints/last.ckpt inference=small.ckpt
  benchmark run time against error of the presets of skip, by stage
              ghgs benchmark checkpoint=runs/train/.../checkpoints/last.ckpt presets=[none,exact,balanced]
  stress    every stage on adversarial inputs, against float64
              ghgs stress quick=true
  table     collect a sweep into the paper's table
              ghgs table runs=runs/train/sweep_..."""

#: Summary and example of each verb.
VERBS = {
    what.split()[0]: (what.split(maxsplit=1)[1], example.strip())
    for what, example in zip(_LISTED.splitlines()[::2], _LISTED.splitlines()[1::2], strict=True)
}


def usage() -> str:
    """The text of ``ghgs --help``."""
    end = "ghgs <verb> --help lists the groups and keys of a verb; ghgs --version prints the version."
    return f"usage: ghgs <verb> [key=value ...] [group=option ...] [-m]\n\n{_LISTED}\n\n{end}"
