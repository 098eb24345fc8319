"""Draw the README's picture: the execution of one simulated cycle, from its record.

python -m tools.figures.cycle_picture -o docs/images/cycle.jpg
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

from tools.shipped_settings import FAKE

WIDTH_PX = 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/images/cycle.jpg"))
    parser.add_argument("--seed", default="1")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        words = ["run", "--config", FAKE, "--seed", options.seed, "--runs", folder]
        subprocess.run([sys.executable, "-m", "cell", *map(str, words)], check=True)
        (path,) = Path(folder).glob("*/execute_passage.jpg")
        picture = cv2.imread(str(path))
    assert picture is not None
    height_px = round(picture.shape[0] * WIDTH_PX / picture.shape[1])
    small = cv2.resize(picture, (WIDTH_PX, height_px), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(options.out), small, [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
