"""What pyproject.toml cannot say: the package has the robots of models/, and the C extension is optional."""

import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_py import build_py

# No contraction: fused operations would give other last digits than the reference in Python does.
OPTIONS = ["/O2"] if sys.platform == "win32" else ["-O3", "-ffp-contract=off"]


class BuildWithModels(build_py):
    """Copies robots to zstate/models, except for an editable install, which finds them where they are."""

    def run(self):
        super().run()
        if not self.editable_mode:
            models = str(Path(self.build_lib, "zstate", "models"))
            self.mkpath(models)
            for path in sorted(Path("models").iterdir()):
                if path.is_file():  # the tutorial is read where the source is
                    self.copy_file(str(path), models)


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
