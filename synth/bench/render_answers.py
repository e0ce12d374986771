"""The findings of `bench render` as sentences; every number comes from the results."""

from collections.abc import Sequence
from math import isfinite

from synth.bench.render_findings import Results, pareto_front
from synth.bench.render_flow import SEEN_PX, Effect, is_unseen
from synth.bench.render_measure import Cell
from synth.render.sample_count import SHARE


def answers(results: Results) -> list[str]:
    """A line each, as Markdown."""
    lines = [_samples(results), *_depth(results), _pareto(results), *_window(results), *_variants(results)]
    lines += [*_flow(results), *_auto(results)]
    lines += [f"**{'Holds' if holds else 'Does not hold'}**: {text}." for text, holds in results.checks().items()]
    return lines


def _samples(results: Results) -> str:
    cells = results.ladder(results.deepest)
    first, last = cells[0], cells[-1]
    text = (
        f"**Samples** (depth {results.deepest}): noise falls from {first.errors.noise:.2f} levels at "
        f"{first.setting.samples} samples per pixel to {last.errors.noise:.3f} at {last.setting.samples}"
    )
    few, many = results.slopes()
    if isfinite(few):
        text += (
            f", as samples^{few:.2f} below the middle of the table and ^{many:.2f} above (independent samples: -0.5)"
        )
    quiet = [cell.setting.samples for cell in cells if cell.errors.noise <= SHARE * results.camera_noise]
    text += f". The camera's own noise in this draw is {results.camera_noise:.2f} levels; "
    return text + (f"a quarter of it is reached with {min(quiet)}." if quiet else "a quarter of it is not reached.")


def _depth(results: Results) -> list[str]:
    cells = results.by_depth()
    if len(cells) < 2:
        return []
    deepest = cells[-1]
    parts = [
        f"{cell.setting.max_depth}: {cell.errors.bias_percent:+.2f} % of the mean"
        + (f", {cell.errors.systematic:.2f} levels" if cell.errors.has_systematic else ", pattern not told from 0")
        + f", {cell.cost / deepest.cost:.2f} of the time"
        for cell in cells[:-1]
    ]
    return [
        f"**Path depth** (bias, systematic error, time over that of depth {deepest.setting.max_depth}, at "
        f"{deepest.setting.samples} samples): {'; '.join(parts)}."
    ]


def _pareto(results: Results) -> str:
    front = pareto_front(results.cells)
    names = [f"{c.setting.samples} samples at depth {c.setting.max_depth} ({c.setting.variant.name})" for c in front]
    return f"**Best for their time**: {', '.join(names)}."


def _window(results: Results) -> list[str]:
    pairs = [(off, on) for off in results.cells if not off.is_error for on in results.cells if _same(off, on)]
    return [
        f"**Window** ({off.setting.variant.name}, {off.setting.samples} samples): with it a frame takes "
        f"{on.cost / off.cost:.2f} times as long and its noise is {on.errors.noise / off.errors.noise:.2f} times "
        f"as large; the pictures differ by {off.errors.rmse:.1f} levels, {off.errors.bias_percent:+.0f} % in the mean."
        for off, on in _largest(pairs)
    ]


def _same(off: Cell, on: Cell) -> bool:
    a, b = off.setting, on.setting
    return b.window and (a.variant.name, a.max_depth, a.samples) == (b.variant.name, b.max_depth, b.samples)


def _largest(pairs: Sequence[tuple[Cell, Cell]]) -> list[tuple[Cell, Cell]]:
    """Of each variant the pair with most samples."""
    found = {pair[0].setting.variant.name: pair for pair in sorted(pairs, key=lambda pair: pair[0].setting.samples)}
    return list(found.values())


def _variants(results: Results) -> list[str]:
    own = {cell.setting.samples: cell for cell in results.ladder(results.own_depth)}
    others: dict[str, Cell] = {}
    for cell in results.cells:
        setting = cell.setting
        if setting.window and setting.variant.name != results.fastest and setting.samples in own:
            others[setting.variant.name] = cell  # the last has most samples
    return [
        f"**{name}** takes {cell.cost / own[cell.setting.samples].cost:.1f} times as long as {results.fastest} "
        f"at {cell.setting.samples} samples and has {cell.errors.noise / own[cell.setting.samples].errors.noise:.2f} "
        f"times its noise; their means differ by "
        f"{cell.errors.bias_percent - own[cell.setting.samples].errors.bias_percent:+.2f} %."
        for name, cell in others.items()
    ]


def _flow(results: Results) -> list[str]:
    lines = []
    for noise in (True, False):
        own = sorted((effect for effect in results.effects if effect.camera_noise == noise), key=lambda e: e.samples)
        parts = []
        for name, changes in (
            ("mean over the pixels", [effect.change for effect in own]),
            ("median pixel", [effect.typical_change for effect in own]),
        ):
            mean = _from(own, [abs(change) <= SEEN_PX for change, _ in changes])
            sure = _from(own, [is_unseen(change) for change in changes])
            if mean is None:
                parts.append(f"{name} at none of the numbers of samples")
                continue
            sure_too = f"from {sure} on" if sure else "not settled"
            parts.append(f"{name} from {mean} samples on, {sure_too} with two standard errors allowed for")
        text = f"**DIS's endpoint error is within {SEEN_PX:g} px of that without render noise**, "
        text += f"{'with' if noise else 'without'} the camera's noise: {'; '.join(parts)}."
        first = own[0].change[0]
        if first < -SEEN_PX:
            text += f" Render noise lowers it, by {-first:.3f} px in the mean at {own[0].samples} samples."
        lines.append(text)
    return lines


def _from(effects: Sequence[Effect], holds: Sequence[bool]) -> int | None:
    """Samples from which on something holds."""
    found = None
    for effect, one in zip(reversed(effects), reversed(holds), strict=True):
        if not one:
            break
        found = effect.samples
    return found


def _auto(results: Results) -> list[str]:
    if not results.choices:
        return []
    picked = [choice.samples for choice in results.choices]
    shares = [choice.share for choice in results.choices]
    text = (
        f'**"auto"** picks {min(picked)} to {max(picked)} samples for {len(picked)} draws of the sensor; render noise '
        f"is then {min(shares):.2f} to {max(shares):.2f} of the camera's"
    )
    fixed = [choice.fixed_noise / choice.camera for choice in results.choices if choice.fixed]
    if fixed:
        own = results.choices[0].fixed
        text += (
            f", and {min(fixed):.2f} to {max(fixed):.2f} with the scene's {own}, which are {min(picked) / own:.0f} to "
        )
        text += f"{max(picked) / own:.0f} times fewer"
    return [text + "."]
