"""Make a clip of a grasp from the log of a robot's simulator: a bar is taken, rolled, dragged and let go.

python examples/make_grasp.py --out data/grasp
"""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import synth

parser = ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("data/grasp"))
parser.add_argument("--set", nargs="*", default=[], help="more settings, such as contact.friction=0.8")
given = parser.parse_args()

# What a simulator logs: places in m and quaternions (w, x, y, z) of sensor and object in its right-handed world. The
# sensor's frame has its origin on the gel, x to the right and y up in the picture, and z into the gel.
time = np.linspace(0.0, 2.4, 25)
sensor_at, sensor_turn = np.array([0.4, -0.1, 0.3]), Rotation.from_euler("xyz", [90, 0, 90], degrees=True)
depth = np.interp(time, [0, 0.6, 1.8, 2.4], [-0.5, 0.7, 0.7, -0.5])
slide, roll = np.interp(time, [0.6, 1.2, 1.8], [0, 0.8, 1.4]), np.interp(time, [0.6, 1.2], [0, 0.2])
logged_at = sensor_at + sensor_turn.apply(np.column_stack([slide, 0 * slide, depth - 4.0]) / 1000)
logged_turn = (sensor_turn * Rotation.from_rotvec(np.outer(-roll, [0, 1, 0]))).as_quat(scalar_first=True)

# Into the scene: the sensor's frame, mm, and y down as in the picture. That mirrors turns about x and about z.
at = 1000 * sensor_turn.inv().apply(logged_at - sensor_at) * [1, -1, 1]
turn = (sensor_turn.inv() * Rotation.from_quat(logged_turn, scalar_first=True)).as_quat() * [-1, 1, -1, 1]
given.out.mkdir(parents=True, exist_ok=True)
log, header = given.out.with_suffix(".csv"), "time_s,x_mm,y_mm,z_mm,qx,qy,qz,qw"
np.savetxt(log, np.column_stack([time, at, turn]), "%.9g", ",", header=header, comments="")

bar = 'contact.indenter={ shape = "cylinder", radius_mm = 4.0, length_mm = 12.0, rotation_deg = [90.0, 0.0, 0.0] }'
settings = [f'motion={{ poses = "{log}" }}', bar, 'sampling.kind="clips"', *given.set]
synth.generate(synth.load_scene("gelsight_mini", set=settings), 1, given.out)
states = next(iter(synth.read_dataset(given.out))).states
print(f"{len(states)} frames, at most {states['fz_n'].max():.2f} N; {states['fz_n'][-1]:.3f} N when it is let go")
