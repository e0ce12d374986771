"""The objects themselves: functions that return a solid in its natural size, in mm.

The side that is worth pressing faces +z, so in a scene without rotation it meets the gel. Walls thinner and reliefs
lower than a soft gel shows are exaggerated where a docstring says so. No object copies a product.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from manifold3d import CrossSection, Manifold
from solids import (
    FloatArray,
    around,
    circle,
    circle_points,
    copies,
    helix,
    hexagon,
    lying,
    polar,
    polygon,
    rectangle,
    rod,
    skin,
    sweep,
    text,
    thread,
    turned,
    union,
)


def hex_nut() -> Manifold:
    """M8 nut: hexagon of 13 mm with chamfered corners, threaded bore with countersinks."""
    rims = rod(15.2, 6.8, chamfer=1.0)
    countersink = turned([(0, 0), (3.3, 0), (4.5, 1.2), (0, 1.2)])
    top, bottom = countersink.translate((0, 0, 5.61)), countersink.rotate((180, 0, 0)).translate((0, 0, 1.19))
    bore = thread(8, 1.25, 8, segments=24).translate((0, 0, -0.6))
    return (hexagon(13).extrude(6.8) ^ rims) - union([bore, top, bottom])


def screw_thread() -> Manifold:
    """Piece of M8 threaded rod, lying."""
    return lying(thread(8, 1.25, 10, segments=24))


def bolt_slotted() -> Manifold:
    """M6 cheese-head screw, slot up, with a short plain shank."""
    head = turned([(0, 0), (5, 0), (4.8, 3), (3.9, 3.9), (0, 3.9)])
    slot = rectangle(12, 1.8).extrude(3).translate((0, 0, 1.9))
    return (head - slot) + rod(6, 5, chamfer=0.6).translate((0, 0, -4.5))


def bolt_socket() -> Manifold:
    """M6 socket head cap screw, hexagon socket of 5 mm up, with a short plain shank."""
    head = turned([(0, 0), (5, 0), (5, 5.3), (4.3, 6), (0, 6)])
    socket = hexagon(5).extrude(4).translate((0, 0, 3))
    return (head - socket) + rod(6, 5, chamfer=0.6).translate((0, 0, -4.5))


def key() -> Manifold:
    """Small flat key, lying: round bow with a hole, blade with cuts on one edge and a milled groove."""
    cuts = [(11, 3), (13, 3), (14, 1.6), (15, 1.6), (16.5, 3), (18.4, 0.6), (19.4, 0.6), (21.4, 2.6)]
    tip = [(22.8, 1), (23.6, 1), (25.2, 2.4), (28, -0.6), (26, -3), (0, -3), (0, 3)]
    outline = polygon([*cuts, *tip]) + circle(13, (4.5, 0)) - circle(4.5, (1.5, 0))
    groove = rectangle(18, 1.1, (20, -1.3)).extrude(1).translate((0, 0, 1.5))
    return outline.extrude(2.2) - groove


def letter(character: str) -> Manifold:
    """Raised character on a square plate."""
    return rectangle(11, 11).extrude(2) + text(character, 8).extrude(1.6).translate((0, 0, 1.9))


def gear_tooth(module: float, teeth: int) -> CrossSection:
    """Tooth of a spur gear about the x axis, involute flanks of 20 degrees (ISO 53), down to the gear's centre."""
    pitch_radius = module * teeth / 2
    base, root = pitch_radius * np.cos(np.radians(20)), pitch_radius - 1.25 * module

    def involute(radius: FloatArray) -> FloatArray:
        pressure_angle = np.arccos(base / radius)
        return np.asarray(np.tan(pressure_angle) - pressure_angle)

    radii = np.linspace(base, pitch_radius + module, 5)
    half_angle = np.pi / (2 * teeth) + involute(np.array(pitch_radius)) - involute(radii)
    radii, half_angle = np.append(root, radii), np.append(half_angle[0], half_angle)
    flank = np.column_stack([radii * np.cos(half_angle), radii * np.sin(half_angle)])
    return polygon(np.vstack([flank * (1, -1), flank[::-1], [(0, 0)]]))


def spur_gear() -> Manifold:
    """Gear of module 1.25 with 12 teeth, recessed between rim and hub, bore with a keyway."""
    wheel = around(gear_tooth(1.25, 12).extrude(4), 12) + circle(11.9).extrude(4)
    recess = (circle(10.2) - circle(7)).extrude(1.2).translate((0, 0, 3))
    bore = circle(4) + rectangle(1.6, 1.4, (2, 0))
    return wheel - recess - bore.extrude(4)


def coin() -> Manifold:
    """Coin with a reeded edge, a rim, beads and a sailing boat; its relief is higher than a mint's."""
    blank = polar([8.0, 7.6] * 50).extrude(2.4) - circle(13.4).extrude(2).translate((0, 0, 1.6))
    hull = polygon([(-4.2, -1.4), (4.4, -1.4), (2.9, -3.2), (-2.9, -3.2)])
    sails = polygon([(0.4, -0.7), (0.4, 4.6), (3.6, -0.7)]) + polygon([(-0.4, -0.7), (-0.4, 3.6), (-3.2, -0.7)])
    beads = around(circle(0.8, (5.8, 0), segments=8).extrude(0.7), 24)
    return blank + ((hull + sails).extrude(0.9) + beads).translate((0, 0, 1.5))


def plug_usb_c() -> Manifold:
    """Front of a plug like USB-C, mouth up; its shell is 0.6 mm thick instead of 0.3 mm."""

    def slot(width: float, height: float) -> CrossSection:
        offset = (width - height) / 2
        return rectangle(width - height, height) + circle(height, (offset, 0)) + circle(height, (-offset, 0))

    shell = (slot(8.4, 2.9) - slot(7.2, 1.7)).extrude(6.5)
    return slot(12, 6).extrude(5) + shell.translate((0, 0, 4.9))


def plug_two_pin() -> Manifold:
    """Mains plug with two flat blades, up; the blades are shorter than real ones."""
    blade = polygon([(-3.2, 0), (3.2, 0), (3.2, 8), (2, 9), (-2, 9), (-3.2, 8)]) - circle(3, (0, 6))
    upright = blade.extrude(1.6).translate((0, 0, -0.8)).rotate((90, 0, 90))
    body = Manifold.batch_hull([rectangle(23, 14).extrude(4).translate((0, 0, 6)), rectangle(15, 10).extrude(1)])
    return body + copies(upright.translate((0, 0, 9.9)), [(-6.35, 0), (6.35, 0)])


def chain_link() -> Manifold:
    """Oval link of round wire, lying."""
    angles = np.radians([*range(-90, 91, 15), *range(90, 271, 15)])
    outward = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    centres = 3.8 * outward + np.repeat([[4.2, 0, 0], [-4.2, 0, 0]], 13, axis=0)
    return sweep(circle_points(3.4, 12), centres, outward, closed=True)


def washer() -> Manifold:
    """M6 washer."""
    return (circle(12) - circle(6.4)).extrude(1.6)


def coil_spring() -> Manifold:
    """Compression spring of six coils with square-cut ends, lying."""
    return lying(helix(circle_points(1.4, 8, at=(3.6, 0)), pitch=2.5, turns=6, segments=20))


def tread() -> Manifold:
    """Piece of a tyre's tread: two zigzag grooves along it, slanted grooves across the shoulders, short sipes."""
    zigzag = np.column_stack([np.linspace(-12, 12, 9), 0.7 * (-1.0) ** np.arange(9)])
    width = np.array([0, 0.7])
    along = polygon(np.vstack([zigzag + width, zigzag[::-1] - width])).extrude(3)
    across = polygon([(-0.75, 0), (0.75, 0), (2.75, 6), (1.25, 6)]).extrude(3)
    sipe = rectangle(1.0, 2.4).rotate(-30).extrude(3)
    grooves = [
        along.translate((0, 3, 0)),
        along.translate((0, -3, 0)),
        copies(across, [(x, 3) for x in (-9, -3, 3)]),
        copies(across.rotate((0, 0, 180)), [(x, -3) for x in (9, 3, -3)]),
        copies(sipe, [(x, 0) for x in (-6, 0, 6)]),
    ]
    return rectangle(20, 16).extrude(5) - union(grooves).translate((0, 0, 2.5))


def studded_brick() -> Manifold:
    """Toy brick with 3 x 2 studs, hollow below with two tubes."""
    places = [(x, y) for x in (-8.0, 0.0, 8.0) for y in (-4.0, 4.0)]
    shell = rectangle(23.8, 15.8).extrude(9.6) - rectangle(20.8, 12.8).extrude(8)
    tube = (circle(6.5) - circle(4.8)).extrude(8.1)
    return shell + copies(rod(4.8, 1.9).translate((0, 0, 9.5)), places) + copies(tube, [(-4, 0), (4, 0)])


def phillips_tip() -> Manifold:
    """Cross-head screwdriver tip of size 2, up: four wings between flutes that run out into the shaft."""
    blank = turned([(0, -8.5), (3, -8.5), (3, -3.2), (1.6, 0), (0, 0)])
    flute = rectangle(8, 8, (4, 4)).rotate(-45).extrude(16).translate((0, 0, -12))
    leaning = flute.rotate((0, -18, 0)).translate((0.7, 0, 0))
    return blank - around(leaning, 4).rotate((0, 0, 45))


def torx_bit() -> Manifold:
    """Driver bit with a six-lobed star, up, on a hexagon shank of 1/4 inch."""
    star = polar(2.4 + 0.45 * np.cos(6 * np.linspace(0, 2 * np.pi, 72, endpoint=False)))
    tip = star.extrude(5) ^ rod(5.9, 5, chamfer=0.6)
    shank = hexagon(6.35).extrude(5) ^ rod(7.4, 5, chamfer=0.9)
    return tip + shank.translate((0, 0, -4.5))


def rack() -> Manifold:
    """Toothed rack of module 1.25, five teeth up, flanks of 20 degrees."""
    half_tip, half_root, pitch = 0.53, 1.55, np.pi * 1.25
    tooth = [(-half_root, 0), (-half_tip, 2.8), (half_tip, 2.8), (half_root, 0)]
    teeth = [(x + pitch * i, z) for i in range(-2, 3) for x, z in tooth]
    profile = polygon([(-2.5 * pitch, -3), (-2.5 * pitch, 0), *teeth, (2.5 * pitch, 0), (2.5 * pitch, -3)])
    return profile.extrude(8).rotate((90, 0, 0))


def comb() -> Manifold:
    """Piece of a comb, lying: nine tapered teeth on a back."""
    tooth = polygon([(-0.65, 0.1), (0.65, 0.1), (0.5, -8), (0, -9), (-0.5, -8)]).extrude(2.5)
    back = rectangle(20, 4, (0, 2)).extrude(2.5)
    return back + copies(tooth, [(2.3 * i, 0) for i in range(-4, 5)])


def knurled_cylinder() -> Manifold:
    """Knob with a diamond knurl, lying: 14 pointed diamonds around, staggered from row to row."""
    row, column = np.indices((13, 28))
    peak = ((row + column) % 2 == 1) & (row > 0) & (row < 12)
    radius, angle = np.where(peak, 4.7, 3.9), -2 * np.pi * column / 28
    return lying(skin(np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.95 * row], axis=-1)))


def pyramid_array() -> Manifold:
    """Plate with 6 x 6 pointed pyramids."""
    pyramid = Manifold.cylinder(1.4, 0.75 * np.sqrt(2), 0, 4).rotate((0, 0, 45)).translate((0, 0, 2))
    steps = 1.7 * (np.arange(6) - 2.5)
    return rectangle(10.4, 10.4).extrude(2.02) + copies(pyramid, [(x, y) for x in steps for y in steps])


def ribbed_pipe() -> Manifold:
    """Corrugated pipe with six ribs, lying."""
    rib = [(3.9, 0.3), (5, 0.7), (5, 1.5), (3.9, 1.9)]
    ribs = [(radius, z + 2.5 * i) for i in range(6) for radius, z in rib]
    return lying(turned([(3, 0), (3.9, 0), *ribs, (3.9, 14.7), (3, 14.7)]))


def ring_with_stone() -> Manifold:
    """Finger ring, its brilliant up, held by a cone-shaped setting with four prongs."""
    profile = [(7, -1.3), (8.1, -1.3), (8.5, -0.6), (8.5, 0.6), (8.1, 1.3), (7, 1.3)]
    band = turned(profile).rotate((90, 0, 0)).translate((0, 0, -10))
    rings = [(circle_points(4.6, 8), 1.6), (circle_points(8, 16), 0.2), (circle_points(8, 16), -0.1)]
    girdle = [(x, y, z) for corners, z in rings for x, y in corners]
    stone = Manifold.hull_points(np.array([*girdle, (0.0, 0.0, -3.0)]))
    setting = turned([(0, -3), (1.8, -3), (3.6, -0.4), (0, -0.4)])
    prong = rod(1.2, 3).translate((3.8, 0, -2.4)).rotate((0, 0, 45))
    return union([band, setting, stone, around(prong, 4)])


OBJECTS: dict[str, Callable[[], Manifold]] = {
    "bolt_slotted": bolt_slotted,
    "bolt_socket": bolt_socket,
    "chain_link": chain_link,
    "coil_spring": coil_spring,
    "coin": coin,
    "comb": comb,
    "cube": partial(Manifold.cube, (8.0, 8.0, 8.0), True),
    "hex_nut": hex_nut,
    "key": key,
    "knurled_cylinder": knurled_cylinder,
    "letter_5": partial(letter, "5"),
    "letter_a": partial(letter, "A"),
    "letter_r": partial(letter, "R"),
    "phillips_tip": phillips_tip,
    "plug_two_pin": plug_two_pin,
    "plug_usb_c": plug_usb_c,
    "pyramid_array": pyramid_array,
    "rack": rack,
    "ribbed_pipe": ribbed_pipe,
    "ring_with_stone": ring_with_stone,
    "screw_thread": screw_thread,
    "spur_gear": spur_gear,
    "studded_brick": studded_brick,
    "torx_bit": torx_bit,
    "tread": tread,
    "washer": washer,
}
