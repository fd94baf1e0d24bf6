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
    """Return a number from the launcher's environment variables that is 0 in the first process
    only: its rank where that is known, before torch.distributed is initialised.
    """
    for key in ("RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK"):
        if key in os.environ:
            return int(os.environ[key])
    return int(os.environ.get("NODE_RANK", 0)) + int(os.environ.get("LOCAL_RANK", 0))
