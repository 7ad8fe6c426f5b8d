"""Fetches weights from the Hugging Face hub and checks what arrived."""

import hashlib
import re
import urllib.error
import urllib.request
from pathlib import Path
from types import ModuleType

from ghgs_lit.errors import InputError

FILE = "model.safetensors"

#: Seconds after which the hub counts as out of reach; its own client would try for half a minute.
PATIENCE = 5.0


def is_repository(name: str) -> bool:
    """Whether ``name`` looks like ``owner/repository`` rather than like a file."""
    return (
        re.fullmatch(r"[\w.-]+/[\w.-]+", name) is not None
        and Path(name).suffix not in (".pt", ".pth", ".bin", ".ckpt", ".safetensors")
        and not Path(name).exists()
    )


def fetch(repository: str, filename: str = FILE) -> tuple[Path, str]:
    """The file of a repository, from the local cache or the hub, and its SHA-256.

    Shows progress, goes on with what an earlier try left, and compares the sum with the published one.

    Raises:
        InputError: the package or the network is missing, the repository is, or the sum is another.
    """
    try:
        import huggingface_hub
    except ImportError:
        raise InputError(
            f"{repository}: expected the package huggingface_hub (pip install 'ghgs-lit[hub]'); found none."
            f" Or fetch https://huggingface.co/{repository}/resolve/main/{filename} by hand and say"
            " vggt=<that file>"
        ) from None
    address = huggingface_hub.hf_hub_url(repository, filename)
    cached = huggingface_hub.try_to_load_from_cache(repository, filename)
    if not isinstance(cached, str):
        _require_network(huggingface_hub, repository, address)
        try:
            cached = huggingface_hub.hf_hub_download(repository, filename)
        except Exception as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise InputError(f"{repository}: expected {address}; found: {reason}") from error
    path = Path(cached)
    return path, _checked(path)


def _require_network(huggingface_hub: ModuleType, repository: str, address: str) -> None:
    """Whether the hub answers at all; what it answers is for its client to read."""
    found = "HF_HUB_OFFLINE is set"
    if not huggingface_hub.constants.HF_HUB_OFFLINE:
        try:
            request = urllib.request.Request(address, method="HEAD")
            urllib.request.urlopen(request, timeout=PATIENCE).close()
            return
        except urllib.error.HTTPError:
            return
        except (urllib.error.URLError, OSError) as error:
            found = str(getattr(error, "reason", error))
    raise InputError(
        f"{repository}: expected the hub or a cached copy; found no connection ({found}). Fetch {address}"
        f" by hand and say vggt=<that file>"
    )


def sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _checked(path: Path) -> str:
    """The sum of a cached file; the cache names large files by the one that the hub published."""
    found, published = sha256(path), path.resolve().name
    if re.fullmatch(r"[0-9a-f]{64}", published) and found != published:
        raise InputError(
            f"{path.resolve()}: expected SHA-256 {published}; found {found}: a broken download, remove it"
        )
    return found
