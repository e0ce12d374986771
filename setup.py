"""The packages, which pyproject.toml cannot tell: `scenes/` at the top of the repository installs as `synth/scenes`."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["synth", "synth.*", "gelflow", "gelflow.*"]), "synth.scenes"],
    package_dir={"synth.scenes": "scenes"},
)
