"""The text of ``ghgs --help``."""

from ghgs_lit.config.registry import verb_class, verbs


def usage() -> str:
    """Every verb with its summary and an example, those of plug-ins last."""
    names = verbs()
    width = max(map(len, names))
    lines = []
    for name in names:
        verb = verb_class(name)
        summary = verb.summary()
        lines.append(f"  {name:{width}} {summary[:1].lower()}{summary[1:]}")
        lines.append(f"  {'':{width}}   {verb.example}")
    end = "ghgs <verb> --help lists the groups and keys of a verb; ghgs --version prints the version."
    return "\n".join(["usage: ghgs <verb> [key=value ...] [group=option ...] [-m]", "", *lines, "", end])
