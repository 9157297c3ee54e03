"""Pictures of docs/gallery.md: `python -m tests.house.gallery` runs its commands and stores the pictures that it shows.

The picture gallery-FOLDER-NAME.png of the page is FOLDER/NAME.png of its commands.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE, FIGURES = ROOT / "docs/gallery.md", ROOT / "replays/figures"


def list_pictures() -> list[tuple[str, str]]:
    """Return file name and source of each picture of the page."""
    page = PAGE.read_text(encoding="utf-8")
    folders = "|".join(re.findall(r"^rig plot .* -o (\S+)", page, re.MULTILINE))
    found = re.findall(rf"\(\.\./replays/figures/(gallery-({folders})-([\w.-]+\.png))\)", page)
    return [(name, f"{folder}/{source}") for name, folder, source in found]


def main() -> None:
    """Run the commands of the page in a temporary folder, and store its pictures."""
    blocks = re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(["bash", "-euc", "".join(blocks)], cwd=folder, env={**os.environ, "PATH": path}, check=True)
        for name, source in list_pictures():
            shutil.copyfile(Path(folder, source), FIGURES / name)
            print(FIGURES / name)


if __name__ == "__main__":
    main()
