"""The stiff and extreme cases: each is run in a process of its own and compared with what was written down beforehand.

`scenes/extreme/base.toml` is the scene, `scenes/extreme/expected.toml` says what each case changes and how it must end.
"""

from synth.stress.suite import run_stress

__all__ = ["run_stress"]
