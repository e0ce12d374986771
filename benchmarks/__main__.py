"""`python -m benchmarks NAME ...` runs the script of that name; `python -m benchmarks NAME --help` tells its options.

A script is a module of this package whose `main(argv)` reads its own options and returns an exit status.
"""

import argparse
import sys
from importlib import import_module

import gelflow.errors
import synth.errors

QUESTIONS = {
    "fem": "displacement's and force's error against run time, by mesh, element and solver options",
    "budget": "do random draws of a scene keep the error that the scene asks for?",
    "batched": "presses a second of the batched solver, and their error against tight solves",
    "agreement": "do the CPU and the GPU give the same trajectories?",
    "objects": "do triangle meshes from files press the gel, and how deep do they sink in?",
    "draws": "do the draws of the shipped scenes complete?",
    "render": "an image's error against rendering time",
    "light": "separated light against path tracing",
    "flow": "the flow's error against its run time",
    "scale": "pairs a second, and where the time goes",
    "throughput": "the main job on this machine: pairs a second, and what limits them",
    "round_gel": "the flow's error against run time for a round gel, by mesh",
    "calibrations": "how near does calibration come to lights that are known?",
    "synthetic_set": "makes the synthetic test set of the report on gelflow",
    "methods": "flow methods' error against their time on one core, and their sigma",
    "paper": "the GelFlow paper's table, and its claims one by one",
    "sigma": "is the flow's uncertainty calibrated? fits its constants",
    "pictures": "draws the README's pictures of data",
}


def main(argv: list[str]) -> int:
    """Run one script.

    Args:
        argv: its name and its options.

    Returns:
        0, 1 if a check of the script failed, 2 for wrong input.
    """
    lines = "\n".join(f"  {name:<13} {question}" for name, question in QUESTIONS.items())
    style = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m benchmarks", epilog=f"names:\n{lines}", formatter_class=style)
    parser.add_argument("name", choices=QUESTIONS, metavar="NAME")
    name = parser.parse_args(argv[:1]).name
    try:
        return int(import_module(f"benchmarks.{name}").main(argv[1:]))
    except (synth.errors.InputError, gelflow.errors.InputError, OSError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
