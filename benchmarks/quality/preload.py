"""Import what training runs import, and the parts that only benchmarks have; :mod:`.forked` does so
before it forks."""

from benchmarks.quality import error_views  # noqa: F401, registers parts
from threestudio_gaussiandreamer import register_parts

register_parts()
