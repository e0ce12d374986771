"""The schema of a scene (pydantic, frozen, one file a part), its template with distributions, and sampling from them.

Template, validation and sampling are imported from their own modules.
"""

from synth.scene.camera import Camera, FurtherCamera, Mirror
from synth.scene.gel import BoxGel, CapsuleGel, DomeGel, FileGel, Gel, Layer, PadGel, RoundGel
from synth.scene.indenter import Box, Cone, Cylinder, Indenter, MeshIndenter, Sphere, Torus
from synth.scene.motion import Motion, Pose
from synth.scene.numerics import Numerics, Render
from synth.scene.part import Part, Vector3
from synth.scene.pattern import Bitmap, Dots, NoPattern, Pattern, RandomColor, Speckle
from synth.scene.scene import Contact, Outputs, Sampling, Scene
from synth.scene.sensor import Coating, Light, MeasuredLight, Sensor
from synth.scene.window import CurvedWindow, PlaneWindow, Window

__all__ = [
    "Bitmap", "Box", "BoxGel", "Camera", "CapsuleGel", "Coating", "Cone", "Contact", "CurvedWindow", "Cylinder",
    "DomeGel", "Dots", "FileGel", "FurtherCamera", "Gel", "Indenter", "Layer", "Light", "MeasuredLight",
    "MeshIndenter", "Mirror", "Motion", "NoPattern", "Numerics", "Outputs", "PadGel", "Part", "Pattern",
    "PlaneWindow", "Pose", "RandomColor", "Render", "RoundGel", "Sampling", "Scene", "Sensor", "Speckle", "Sphere",
    "Torus", "Vector3", "Window",
]  # fmt: skip
