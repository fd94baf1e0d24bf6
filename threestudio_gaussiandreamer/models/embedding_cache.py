"""Cache text embeddings on disk: one safetensors file per (model, text), written atomically."""

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Optional

from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.files import atomic_file, output_folder
from ..host import debug

FORMAT = 1
"""Version of the cache's content, part of the key: increase it when an encoder's output for the
same model and text changes.
"""

Encode = Callable[[list[str]], list[Float[Tensor, "N F"]]]


def require_cache_folder(folder: Path) -> None:
    """Check that embeddings can be written into ``folder``, without making it.

    Raises:
        UserError: it, or the nearest existing folder above it, is a file or read-only, or it can't
            be a folder's name.
    """
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        read_only = "" if os.access(existing, os.W_OK | os.X_OK) else "is read-only"
        reason = read_only if existing.is_dir() else "is no folder"
        reason = reason and f"{str(existing)!r} {reason}"
    except OSError as error:  # the name is too long
        reason = error.strerror
    if reason:
        raise UserError(
            f"the folder of text embeddings {str(folder)!r} can't be written ({reason}): set "
            "system.prompt_processor.cache_dir to another one, or use_cache=false"
        )


class EmbeddingCache:
    """The embeddings of one model's text encoder in ``folder``.

    Args:
        folder: contains the files; created on the first write.
        model: ``model_files.fingerprint`` of the tokenizer and the text encoder.
    """

    def __init__(self, folder: str, model: str) -> None:
        self.folder, self.model = Path(folder).expanduser(), model

    def path(self, text: str) -> Path:
        key = json.dumps([FORMAT, self.model, text])
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()}.safetensors"

    def read(self, text: str) -> Optional[Float[Tensor, "N F"]]:
        """Return the embedding of ``text``; None if it isn't cached or its file is damaged."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        path = self.path(text)
        try:
            return load(path.read_bytes())["embedding"]
        except FileNotFoundError:
            return None
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            debug(f"the cached text embedding {path} can't be read and is made again: {error}")
            return None

    def write(self, text: str, embedding: Float[Tensor, "N F"]) -> None:
        """Store one embedding atomically; raise UserError if the folder can't be written."""
        from safetensors.torch import save

        output_folder(self.folder, "system.prompt_processor.cache_dir")
        content = {"embedding": embedding.float().cpu().contiguous()}
        with atomic_file(self.path(text)) as file:
            file.write(save(content, metadata={"text": text}))

    def embed(self, texts: list[str], encode: Encode) -> list[Float[Tensor, "N F"]]:
        """Return the embeddings of ``texts``; those that aren't cached are encoded and stored."""
        found = {text: self.read(text) for text in texts}
        missing = [text for text, embedding in found.items() if embedding is None]
        if missing:
            require_cache_folder(self.folder)  # before the encoder is loaded
            found |= zip(missing, encode(missing), strict=True)
        for text in missing:
            self.write(text, found[text])
        return [found[text] for text in texts]
