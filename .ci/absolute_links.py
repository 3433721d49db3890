"""Makes the links of a Markdown file absolute, as a package index has no other files to lead to.

absolute_links.py REF FILE rewrites FILE, which is at the top of the repository; REF is a tag.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
_LINK = re.compile(r"(!?)\[([^\[\]]*)\]\((?!\w+:|#)([^()\s]+)\)")


def with_absolute_links(text: str, ref: str) -> str:
    """``text`` with links to files of the repository at ``ref``; pictures are loaded from there."""
    home = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["urls"]["Homepage"]
    pictures = home.replace("://github.com/", "://raw.githubusercontent.com/")

    def absolute(link: re.Match[str]) -> str:
        picture, label, target = link.groups()
        path = ROOT / target.partition("#")[0]
        base = f"{pictures}/{ref}" if picture else f"{home}/{'tree' if path.is_dir() else 'blob'}/{ref}"
        return f"{picture}[{label}]({base}/{target})"

    return _LINK.sub(absolute, text)


if __name__ == "__main__":
    ref, file = sys.argv[1], Path(sys.argv[2])
    file.write_text(with_absolute_links(file.read_text(), ref))
