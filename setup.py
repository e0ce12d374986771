"""The packages, which pyproject.toml cannot tell: `scenes/` at the top of the repository installs as `synth/scenes`."""

from setuptools import find_namespace_packages, setup

setup(
    packages=[
        *find_namespace_packages(include=["synth*", "gelflow*"]),
        *(f"synth.{name}" for name in find_namespace_packages(include=["scenes*"])),
    ],
    package_dir={"synth.scenes": "scenes"},
)
