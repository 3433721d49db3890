"""Build steps beyond pyproject.toml: the robots of models/ in the package, and an optional C extension."""

import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_py import build_py

# No contraction: fused operations would change the last digits compared with the reference in Python.
OPTIONS = ["/O2"] if sys.platform == "win32" else ["-O3", "-ffp-contract=off"]


class BuildWithModels(build_py):
    """Copies robots to zstate/models; an editable install finds them in models/ instead."""

    def run(self):
        super().run()
        if not self.editable_mode:
            models = str(Path(self.build_lib, "zstate", "models"))
            self.mkpath(models)
            for path in sorted(Path("models").iterdir()):
                if path.is_file():  # not the tutorial, which is read in the source tree
                    self.copy_file(str(path), models)


setup(
    cmdclass={"build_py": BuildWithModels},
    ext_modules=[
        # Skipped without a C compiler; the reference in Python is used instead.
        Extension(
            "zstate._kernel",
            ["zstate/buffer/_kernel.c"],
            depends=sorted(str(path) for path in Path("zstate/buffer/_kernel").glob("*.h")),
            extra_compile_args=OPTIONS,
            optional=True,
        )
    ],
)
