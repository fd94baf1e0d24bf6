"""Log messages from rank 0 only; the launcher configures the handlers."""

import logging
import os

logger = logging.getLogger("threestudio_gaussiandreamer")


def debug(*args: object, **kwargs: object) -> None:
    _log(logging.DEBUG, *args, **kwargs)


def info(*args: object, **kwargs: object) -> None:
    _log(logging.INFO, *args, **kwargs)


def warn(*args: object, **kwargs: object) -> None:
    _log(logging.WARNING, *args, **kwargs)


def _log(level: int, *args: object, **kwargs: object) -> None:
    if get_rank() == 0:
        logger.log(level, *args, **kwargs)


def get_rank() -> int:
    """Return the rank of this process from its environment variables; 0 if none is set."""
    ranks = (
        os.environ.get(key) for key in ("RANK", "LOCAL_RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK")
    )
    return int(next((rank for rank in ranks if rank is not None), 0))
