"""Every picture of a list decodes to its last row with Pillow."""

import sys
from pathlib import Path

from PIL import Image

for line in Path(sys.argv[1]).read_text().split("\n"):
    if line and Path(line).exists():
        with Image.open(line) as picture:
            picture.load()
