"""Print requirements with the lowest declared version of every dependency, for `make test-lowest`:

    python -m tests.lowest                 # of the base and of the extra test
    python -m tests.lowest diffusion mesh  # and of these extras

torch keeps the version of constraints.txt: its older builds come only with CUDA, about 3 GB.
"""

import re
import sys
from pathlib import Path

import tomllib

ROOT = Path(__file__).resolve().parents[1]


def main(extras: list[str]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = list(project["dependencies"])
    for extra in ("test", *extras):
        wanted += project["optional-dependencies"][extra]
    tested = (ROOT / "constraints.txt").read_text(encoding="utf-8")
    for requirement in wanted:
        if requirement.startswith("torch>"):
            print(re.search("^torch==[0-9.]+", tested, re.MULTILINE)[0])
        else:
            print(re.sub(r">=([^,;]+)(,[^;]*)?", r"==\1", requirement))


if __name__ == "__main__":
    main(sys.argv[1:])
