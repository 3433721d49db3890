"""What pyproject.toml cannot say: models/ is shipped inside the package, and the C extension is optional."""

import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_py import build_py

# No contraction: fused operations would give other last digits than the reference in Python does.
OPTIONS = ["/O2"] if sys.platform == "win32" else ["-O3", "-ffp-contract=off"]


class BuildWithModels(build_py):
    """Copies models/ to zstate/models, except for an editable install, which finds them where they are."""

    def run(self):
        super().run()
        if not self.editable_mode:
            self.copy_tree("models", str(Path(self.build_lib, "zstate", "models")))


setup(
    cmdclass={"build_py": BuildWithModels},
    ext_modules=[
        # Where there is no C compiler it is left out, and the reference does its work.
        Extension(
            "zstate._kernel",
            ["zstate/buffer/_kernel.c"],
            depends=sorted(str(path) for path in Path("zstate/buffer/_kernel").glob("*.h")),
            extra_compile_args=OPTIONS,
            optional=True,
        )
    ],
)
