"""The built-in host: threestudio's contract for parts and systems, on Lightning alone.

Used by :mod:`threestudio_gaussiandreamer.host` when threestudio isn't importable. Class, method and
key names are threestudio's, so that a part written for one host runs in the other."""
