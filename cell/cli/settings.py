"""Commands about settings, which move nothing: check, schema."""

from __future__ import annotations

import json

from cell.cli.shared import Config, group, refuse

app = group()


@app.command()
def check(config: Config) -> None:
    """Validate settings without moving anything.

    Ends with 0 if they are right, 2 if not; every mistake is named with line and column.
    """
    from cell.files.input_error import InputError
    from cell.settings import load_settings

    try:
        settings = load_settings(config)
    except InputError as error:
        refuse(error)
    offsets_m = settings.motion.offsets.values_m
    print(
        f"{config}: right; arm {settings.arm.kind}, camera {settings.camera.kind}, gripper "
        f"{settings.gripper.kind}; {len(offsets_m)} offsets, {offsets_m[0] * 1e3:g} … "
        f"{offsets_m[-1] * 1e3:g} mm"
    )


@app.command()
def schema() -> None:
    """Print the JSON schema of the settings, for editors."""
    from cell.settings import Settings

    print(json.dumps(Settings.model_json_schema(), indent=2, ensure_ascii=False))
