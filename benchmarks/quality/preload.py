"""Import what training runs import; :mod:`.forked` does so before it forks."""

from threestudio_gaussiandreamer import register_parts

register_parts()
