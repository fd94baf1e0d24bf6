"""Networks that stay in memory for the next run of this process.

One run loads each network, uses it and drops it. A process that makes many assets calls
:func:`keep_loaded` first: then each network is loaded once. What a caller changes in a network
must be part of ``load``, and everything that it depends on part of the key, so that the next run
gets what it would have loaded itself."""

from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

_kept: dict[Hashable, Any] = {}
_counts: Counter = Counter()
_keeps = False


def keep_loaded(keep: bool = True) -> None:
    """Keep networks from now on; with ``keep=False`` drop those that were kept."""
    global _keeps
    _keeps = keep
    _counts.clear()
    if not keep:
        _kept.clear()


def loaded(key: tuple[Hashable, ...], load: Callable[[], Any]) -> Any:
    """Return ``load()``, or what it returned for the same key earlier.

    Args:
        key: the network's name for :func:`load_counts`, then all that ``load`` depends on: folder,
            component, number type, device and options.
    """
    if key in _kept:
        return _kept[key]
    network = load()
    _counts[str(key[0])] += 1
    if _keeps:
        _kept[key] = network
    return network


def load_counts() -> dict[str, int]:
    """Return how often each network was loaded since :func:`keep_loaded`, by name."""
    return dict(_counts)
