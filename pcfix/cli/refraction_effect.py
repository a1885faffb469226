"""``pcfix simulate --refraction-effect`` and the options that go with it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated

import typer

from pcfix.errors import SettingError

if TYPE_CHECKING:
    from pathlib import Path

    from pcfix.simulate.refraction_effect import AerialCamera

PANEL = "With --refraction-effect"


@dataclass(frozen=True)
class EffectWords:
    """A pair of vertical images, and how far refraction puts its points wrong."""

    refraction_effect: Annotated[
        bool,
        typer.Option(
            "--refraction-effect",
            help="No scene, but how far refraction puts points wrong in a pair of vertical images"
            " (Skarlatos & Agrafiotis 2018, Figures 4 to 6): maps, tables.",
        ),
    ] = False
    effect_focal_mm: Annotated[
        float | None,
        typer.Option(
            help="Focal length of a camera of your own, with --effect-frame-px and"
            " --effect-pixel-um.",
            show_default="the paper's two cameras",
            rich_help_panel=PANEL,
        ),
    ] = None
    effect_frame_px: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Its frame, as 4000x3000; the height is flown along.",
            rich_help_panel=PANEL,
        ),
    ] = None
    effect_pixel_um: Annotated[
        float | None, typer.Option(help="Its pixel size.", rich_help_panel=PANEL)
    ] = None
    effect_overlap: Annotated[
        float | None,
        typer.Option(
            help="Overlap of the two images, 0 to 1.", show_default="0.8", rich_help_panel=PANEL
        ),
    ] = None
    effect_heights: Annotated[
        str | None,
        typer.Option(
            metavar="M,M,...",
            help="Above the water.",
            show_default="50,100,200; UltraCam 500,1000,3000",
            rich_help_panel=PANEL,
        ),
    ] = None
    effect_depths: Annotated[
        str | None,
        typer.Option(
            metavar="M,M,...",
            help="Depths that the cloud shows; maps are drawn of the largest.",
            show_default="1,2,5,10,15",
            rich_help_panel=PANEL,
        ),
    ] = None


def check_unused(words: EffectWords) -> None:
    """Refuse options that say nothing without --refraction-effect."""
    for one in fields(words):
        if getattr(words, one.name) != one.default:
            option = "--" + one.name.replace("_", "-")
            raise SettingError(f"{option} goes with --refraction-effect; add it or leave it out.")


def refraction_effect(
    words: EffectWords, out_dir: Path, *, index: float, seed: int, overwrite: bool
) -> str:
    """Write the effect of refraction into a folder and return the summary."""
    from pcfix.flow.papers import write_refraction_effect
    from pcfix.simulate.refraction_effect import APPARENT_DEPTHS_M, OVERLAP

    heights, depths = words.effect_heights, words.effect_depths
    return write_refraction_effect(
        out_dir,
        camera=_camera(words),
        overlap=OVERLAP if words.effect_overlap is None else words.effect_overlap,
        flying_heights_m=_numbers("--effect-heights", heights) if heights else None,
        apparent_depths_m=_numbers("--effect-depths", depths) if depths else APPARENT_DEPTHS_M,
        refractive_index=index,
        seed=seed,
        overwrite=overwrite,
    )


def _camera(words: EffectWords) -> AerialCamera | None:
    from pcfix.simulate.refraction_effect import AerialCamera

    focal, frame, pixel = words.effect_focal_mm, words.effect_frame_px, words.effect_pixel_um
    if focal is None and frame is None and pixel is None:
        return None
    if focal is None or frame is None or pixel is None:
        raise SettingError(
            "a camera needs --effect-focal-mm, --effect-frame-px and --effect-pixel-um; give all"
            " three."
        )
    try:
        width, height = (int(side) for side in frame.lower().split("x"))
    except ValueError:
        raise SettingError(
            f"--effect-frame-px {frame} is not WIDTHxHEIGHT in pixels, as 4000x3000."
        ) from None
    return AerialCamera("camera", focal, width, height, pixel)


def _numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        found = tuple(dict.fromkeys(float(word) for word in text.split(",")))
    except ValueError:
        raise SettingError(f"{option} {text} is not a list of numbers, as 50,100.") from None
    if len(found) > 6:
        raise SettingError(f"{option} {text} has {len(found)} numbers; give 6 at most.")
    return found
