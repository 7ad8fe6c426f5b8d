"""Downloads weights from the Hugging Face hub and verifies their checksum."""

import hashlib
import re
from pathlib import Path

from ghgs_lit.errors import InputError

FILE = "model.safetensors"


def is_repository(name: str) -> bool:
    """Whether ``name`` looks like ``owner/repository`` rather than like a file."""
    return (
        re.fullmatch(r"[\w.-]+/[\w.-]+", name) is not None
        and Path(name).suffix not in (".pt", ".pth", ".bin", ".ckpt", ".safetensors")
        and not Path(name).exists()
    )


def fetch(repository: str, filename: str = FILE) -> tuple[Path, str]:
    """The path of a repository's file and its SHA-256, from the local cache or the hub.

    Shows progress, resumes an earlier download, and compares the checksum with the published one.
    ``repository``: ``owner/repository``. InputError: the package, the network or the repository is missing,
    or the checksum differs.
    """
    try:
        import huggingface_hub
    except ImportError:
        raise InputError(
            f"{repository}: expected the package huggingface_hub (pip install 'ghgs-lit[hub]'); found none."
            f" Or download https://huggingface.co/{repository}/resolve/main/{filename} by hand and set"
            " vggt=<that file>"
        ) from None
    address = huggingface_hub.hf_hub_url(repository, filename)
    cached = huggingface_hub.try_to_load_from_cache(repository, filename)
    if not isinstance(cached, str):
        try:
            cached = huggingface_hub.hf_hub_download(repository, filename)
        except Exception as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise InputError(
                f"{repository}: expected the hub or a cached copy; found: {reason}. Download {address} by"
                " hand and set vggt=<that file>"
            ) from error
    path = Path(cached)
    return path, _checked(path)


def sha256(path: Path) -> str:
    """The checksum of a file in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _checked(path: Path) -> str:
    """The checksum of a cached file, which the cache names by the published one."""
    found, published = sha256(path), path.resolve().name
    if re.fullmatch(r"[0-9a-f]{64}", published) and found != published:
        raise InputError(
            f"{path.resolve()}: expected SHA-256 {published}; found {found}: a broken download: delete it"
        )
    return found
