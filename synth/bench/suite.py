"""Which settings are run on which case: the whole benchmark and its quick part."""

from dataclasses import dataclass, replace

from synth.bench.cases import HELD, OFF_CENTRE, SHEARED, Case
from synth.bench.setting import Fine, Graded, Setting, Uniform, Wild, of_family
from synth.scene import Numerics
from synth.simulate.driver import Driver

PLAIN_MESH = Uniform((20, 16, 4))
PLAIN_DRIVER = Driver(loose=0.0, extrapolate=False, single_precision=False, keep_factors=False)
PLAIN = Setting("plain driver", PLAIN_MESH, driver=PLAIN_DRIVER)
"""What a textbook would do: a uniform mesh, every step solved to the full tolerance from the last state, and every
tangent factorised, in double precision. Elements, contact and line search are the same."""
BASE = Setting("graded P2/P1", Graded(8))
"""What the variants vary."""
WIDE = Setting("graded, wide P2/P1", Fine(12))
"""A mesh like the references', with more elements beside the contact; no scene chooses it."""


@dataclass(frozen=True)
class Suite:
    """Settings by case.

    Attributes:
        cases: each with its settings.
        reference: mesh that errors are measured against.
        check: a coarser one; the difference of the two tells how far the reference itself can be trusted.
        profiled: setting of the first case whose time is taken apart.
    """

    cases: tuple[tuple[Case, tuple[Setting, ...]], ...]
    reference: Fine
    check: Fine
    profiled: Setting


def variants() -> list[Setting]:
    """One parameter of BASE changed at a time."""
    found = [
        replace(BASE, family="load step", numerics=Numerics(max_step_mm=step), detail=f"steps of {step:g} mm")
        for step in (0.125, 0.5)
    ]
    found += [
        replace(BASE, family="penalty", numerics=Numerics(penalty=value), detail=f"penalty {value:g} E/mm")
        for value in (25.0, 100.0, 200.0)
    ]
    found += [replace(BASE, family="contact points", contact_split=1, detail="3 points a face")]
    found += [replace(BASE, family="factor", driver=Driver(single_precision=False), detail="float64")]
    found += [replace(BASE, family="factor", driver=Driver(keep_factors=False), detail="every tangent factorised")]
    found += [replace(BASE, family="plain driver", driver=PLAIN_DRIVER)]
    return found


def whole() -> Suite:
    """Some fifteen minutes on two cores."""
    held = of_family("graded", "p2p1", *map(Graded, (4, 6, 8, 10, 12, 14)))
    held += of_family("graded, few layers", "p2p1", Graded(6, 2), Graded(8, 2), Graded(10, 2))
    held += of_family("graded", "p1p1", *map(Graded, (4, 6, 8, 10, 12, 14)))
    held += of_family("graded", "p1", Graded(8))
    held += of_family("fTetWild", "p2p1", Wild(1.0, 3.0), Wild(0.75, 2.5), Wild(0.6, 2.2))
    held += of_family("fTetWild", "p1p1", Wild(0.6, 2.2))
    held += of_family("uniform", "p2p1", Uniform((14, 10, 3)), PLAIN_MESH)
    held += of_family("uniform", "p1p1", Uniform((14, 10, 3)), PLAIN_MESH)
    held += of_family("uniform", "p1", PLAIN_MESH)
    others = of_family("graded", "p2p1", *map(Graded, (4, 6, 8, 10, 12)))
    others += of_family("graded, few layers", "p2p1", Graded(6, 2), Graded(8, 2))
    others += of_family("graded", "p1p1", *map(Graded, (8, 12)))
    others += of_family("fTetWild", "p2p1", Wild(1.0, 3.0), Wild(0.75, 2.5))
    few = [v for v in variants() if v.family in ("contact points", "load step", "factor")]
    return Suite(
        (
            (HELD, (PLAIN, *held, *variants())),
            (OFF_CENTRE, (PLAIN, *others)),
            (SHEARED, (PLAIN, *others, WIDE, *few)),
        ),
        Fine(16),
        Fine(12),
        Setting("graded P2/P1", Graded(10)),
    )


def quick() -> Suite:
    """The held case with a handful of settings, against a coarser reference: about two minutes."""
    held = of_family("graded", "p2p1", *map(Graded, (4, 6, 8)))
    held += of_family("graded", "p1p1", *map(Graded, (6, 10)))
    held += of_family("fTetWild", "p2p1", Wild(1.0, 3.0))
    held += [variant for variant in variants() if variant.family == "contact points"]
    return Suite(((HELD, (PLAIN, *held)),), Fine(12, 4), Fine(10, 4), BASE)
