"""One picture of all four systems, of the pictures that the other demos leave: `docs/images/gallery.png`."""

import argparse
import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

HERE = Path(__file__).resolve().parent
LEFT = {
    "city.png": "lightmap: a tile over the day; reference, decoded, error x 8",
    "smoke/plume.png": "smoke: a simulated plume under a moving light; its six-way lightmaps",
}
RIGHT = {
    "room.png": "atlas: a room's lightmap; original, decoded, downsampled to as many bytes, errors x 8",
    "street.png": "probe: light probes as lit spheres; original, decoded, error x 8",
}
WIDTH, LEFT_WIDTH, LINE, MARGIN = 1500, 516, 26, 8
PAPER, INK = (32, 32, 32), (230, 230, 230)


def column(folder: Path, captions: dict[str, str], width: int) -> Image.Image:
    """Pictures below each other, each under its caption and as wide as the column."""
    font = ImageFont.load_default(15)
    parts = []
    for name, caption in captions.items():
        picture = Image.open(folder / name).convert("RGB")
        picture = picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS)
        parts.append((caption, picture))
    sheet = Image.new("RGB", (width, sum(LINE + picture.height + MARGIN for _, picture in parts)), PAPER)
    top = 0
    for caption, picture in parts:
        ImageDraw.Draw(sheet).text((4, top + 4), caption, INK, font=font)
        sheet.paste(picture, (0, top + LINE))
        top += LINE + picture.height + MARGIN
    return sheet


def main() -> None:
    """Reads the command line and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "out", help="the folder of the demos' pictures")
    out = parser.parse_args().out
    try:
        left = column(out, LEFT, LEFT_WIDTH)
        right = column(out, RIGHT, WIDTH - LEFT_WIDTH - MARGIN)
    except OSError as error:
        sys.exit(f"error: {error}; expected the pictures of the other demos")
    sheet = Image.new("RGB", (WIDTH, max(left.height, right.height)), PAPER)
    sheet.paste(left, (0, 0))
    sheet.paste(right, (left.width + MARGIN, 0))
    sheet.save(out / "gallery.png")
    print(f"{out.name}/gallery.png: {sheet.width} x {sheet.height} pixels")


if __name__ == "__main__":
    main()
