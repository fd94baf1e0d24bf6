"""A cache of networks for processes with several runs.

By default each run loads its networks and drops them at its end. After :func:`keep_loaded` each
network is loaded only once per process. The next run must get the same network as if it had loaded
it: changes of a network (its device, compilation) must happen inside ``load``."""

from collections import Counter
from collections.abc import Callable, Hashable
from typing import Any

from ..core.extras import require_extra

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


def keep_on_cpu(network: Any, device: Any) -> None:
    """Keep the weights in the CPU's memory, and copy those of each layer to ``device`` while it
    computes.
    """
    require_extra("diffusion", "accelerate")
    from accelerate import cpu_offload

    cpu_offload(network, execution_device=device)


def load_counts() -> dict[str, int]:
    """Return how often each network was loaded since :func:`keep_loaded`, by name."""
    return dict(_counts)
