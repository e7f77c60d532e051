"""Makes an HTML page of each of the four systems from the files of the other demos, a page that frames these four, and
a viewer.

The pages need no server: a double click on `gallery.html` opens them.
"""

import argparse
import sys
from pathlib import Path

from wlm.errors import WlmError
from wlm.export import write_page, write_viewer

HERE = Path(__file__).resolve().parent
DATA = HERE / "data"
PAGES = {
    "city": ("Lightmaps over the day", ["city.wlm"], {"original": DATA / "city"}),
    "room": ("A mesh's lightmap", ["room-standard.wlm"], {"original": DATA / "atlas" / "room.exr"}),
    "street": ("Light probes", ["street.wlm"], {"original": DATA / "probes" / "street.npz", "key": "12.00"}),
    "plume": ("Six-way lightmaps of smoke", [f"smoke/plume_{a:02}.exr" for a in (0, 30, 60, 90)], {"rate": 2.0}),
}
FRAME = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>wlm: compressed precomputed lighting</title>
<style>
body {{ margin: 0; background: #202024; color: #e6e6e6; font: 15px/1.5 system-ui, sans-serif; }}
main {{ display: grid; gap: 12px; padding: 12px; }}
main {{ grid-template-columns: repeat(auto-fit, minmax(min(100%, 640px), 1fr)); }}
h2 {{ font-size: 16px; margin: 0 0 6px; }}
a {{ color: #ffb454; }}
iframe {{ width: 100%; height: 540px; border: 1px solid #3a3a42; }}
</style>
<main>
{}
</main>
</html>
"""


def pages(out: Path) -> int:
    """Writes a page of each system, one that frames them, and a viewer of other files; returns their bytes."""
    sections, size = [], write_viewer(out / "viewer.html")
    for name, (title, files, options) in PAGES.items():
        size += write_page(out / f"{name}.html", [out / file for file in files], **options)
        link = f'<a href="{name}.html">{title}</a>'
        sections.append(f'<section><h2>{link}</h2><iframe src="{name}.html" title="{title}"></iframe></section>')
    (out / "gallery.html").write_text(FRAME.format("\n".join(sections)), encoding="utf-8")
    return size


def main() -> None:
    """Reads the command line and writes the pages."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=HERE / "out", help="the folder of the demos' files")
    out = parser.parse_args().out
    try:
        size = pages(out)
    except (OSError, WlmError) as error:
        sys.exit(f"error: {error}; expected what the other demos leave")
    print(f"{out.name}/gallery.html: {len(PAGES)} pages, {size:,} bytes")


if __name__ == "__main__":
    main()
