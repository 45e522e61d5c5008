"""The hash of the measurements that a result rests on, in one form for all kinds."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable


def data_hash(pieces: Iterable[bytes]) -> str:
    """``sha256:`` and the hash of all pieces in their order."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return f"sha256:{digest.hexdigest()}"
