"""Log messages from rank 0 only; the launcher configures the handlers."""

import logging
import os


def get_rank() -> int:
    """Return a number from the launcher's environment variables that is 0 in the first process
    only: its rank where that is known, before torch.distributed is initialised.
    """
    for key in ("RANK", "SLURM_PROCID", "JSM_NAMESPACE_RANK"):
        if key in os.environ:
            return int(os.environ[key])
    return int(os.environ.get("NODE_RANK", 0)) + int(os.environ.get("LOCAL_RANK", 0))


logger = logging.getLogger("threestudio_gaussiandreamer")
logger.addFilter(lambda record: get_rank() == 0)
debug, info, warn = logger.debug, logger.info, logger.warning
