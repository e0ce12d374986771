"""What fits the schema of a scene and still cannot be built."""

from synth.errors import InputError
from synth.mesh import default_edge_length, face_of
from synth.mesh.cad import CadFace
from synth.render.camera_rays import pinhole
from synth.render.lights import check_view
from synth.render.pattern import check_pattern
from synth.render.separated_light import is_separated
from synth.render.thin_lens import ThinLens
from synth.render.variant import Variant
from synth.scene import MeshIndenter
from synth.scene.sampling import check_pairs
from synth.scene.template import Template
from synth.simulate.indenter import rigid_body
from synth.simulate.object_surface import object_triangles


def check_buildable(template: Template, variant: Variant) -> None:
    """Build what fits the schema and may still be impossible, so that a job does not find out after its first hour.

    Raises:
        InputError: at a corner of the distributions, an indenter whose parts do not fit or whose file is no surface,
            a gel from files that is too thin or is pressed beside its face, a light in the camera's view, a lens or a
            kind of light that this variant or coating cannot have, a pattern that no pixel could show or whose file is
            no picture, or more pairs than a trajectory has.
    """
    try:
        for sensor in dict.fromkeys(view for corner in template.corners for view in corner.sensor.views.values()):
            check_view(sensor)
            ThinLens.of(sensor)
            if not variant.is_vectorised:
                pinhole(sensor)
        for sensor in dict.fromkeys(corner.sensor for corner in template.corners):
            check_pattern(sensor, template.folder)
        for indenter in dict.fromkeys(corner.contact.indenter for corner in template.corners):
            if isinstance(indenter, MeshIndenter):
                object_triangles(indenter, template.folder)
            else:
                rigid_body(indenter)
        for corner in template.corners:
            gel = corner.sensor.gel
            if isinstance(face := face_of(gel, template.folder), CadFace):
                face.check(corner.motion, corner.numerics.edge_length_mm or default_edge_length(gel))
            is_separated(corner.render, corner.sensor.coating, variant)
            check_pairs(corner)
    except InputError as error:
        raise InputError(f"{template.label}: {error}") from error
