"""Settings → the types of the rooms below."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from cell.cable.effects import Effect
from cell.cable.geometry import Cable
from cell.identify.individual import IdentifyOptions
from cell.identify.model_class import ModelClass, effect_from
from cell.settings import model as schema
from cell.settings.devices import FilesCameraSettings
from cell.settings.model import Settings
from cell.vision.detect import VisionOptions
from cell.vision.marks import JawMarks
from drivers.guard import ArmLimits
from drivers.interfaces import Pose


def cable_of(settings: Settings) -> Cable:
    """Data sheet of the cable."""
    return Cable(**settings.cable.model_dump())


def pose_of(pose: schema.HandPose) -> Pose:
    """Pose of the gripping point in the cell's plane."""
    return Pose(pose.x_m, pose.y_m, pose.angle_rad)


def pose_from_home(settings: Settings, x_m: float, y_m: float, angle_rad: float) -> Pose:
    """Pose with x and y relative to the cell's home, and an absolute clamp angle."""
    home = settings.motion.home
    return Pose(home.x_m + x_m, home.y_m + y_m, angle_rad)


def arm_limits_of(settings: Settings) -> ArmLimits:
    """Limits within which the arm may move."""
    limits = settings.limits
    return ArmLimits(
        *limits.x_m,
        *limits.y_m,
        *limits.angle_rad,
        max_speed_m_per_s=limits.velocity_m_per_s,
        max_acceleration_m_per_s2=limits.acceleration_m_per_s2,
        max_jerk_m_per_s3=limits.jerk_m_per_s3,
    )


def picture_size(settings: Settings) -> tuple[int, int]:
    """Width and height of the camera's pictures, px; for a folder of pictures a default size."""
    camera = settings.camera
    if isinstance(camera, FilesCameraSettings):
        return 1280, 1024
    return camera.width_px, camera.height_px


def vision_of(settings: Settings) -> VisionOptions:
    """Vision options from the settings."""
    vision = settings.vision
    return VisionOptions(
        free_length_m=settings.cable.free_length_m,
        length_tolerance_m=vision.length_tolerance_m,
        nodes=vision.nodes,
        cable_is=vision.cable_is,
        min_contrast=vision.min_contrast,
        line_width_px=vision.line_width_px,
        marks=JawMarks(vision.jaw.discs_m, vision.jaw.radius_m),
    )


def identification_of(settings: Settings) -> IdentifyOptions:
    """Options of the identification, with the settings' model.  Raises as `model_class_of`."""
    method = settings.identification.method
    return IdentifyOptions(method=method, kind=model_class_of(settings.model))


def model_class_of(model: schema.ModelSettings) -> ModelClass:
    """Model class of the settings: the effects and priors that all cables have in common.

    raises  KeyError, FileNotFoundError, EffectError: an effect is missing or wrong; ValueError: it
            has no such parameter
    """
    effects: list[type[Effect]] = []
    exact: list[tuple[str, float]] = []
    names, means, stds = [], [], []
    for entry in model.effects:
        effect = effect_from(entry.effect)
        effects.append(effect)
        parameters = {p.name: p for p in effect.parameters}
        for key, stated in entry.parameters.items():
            if key not in parameters:
                raise ValueError(f"{effect.name} has no parameter {key!r}; it has {[*parameters]}")
            if isinstance(stated, str):
                continue
            name = f"{effect.name}.{key}"
            if stated.std == 0.0:
                effect.active(**{key: stated.fixed})
                exact.append((name, stated.fixed))
                continue
            names.append(name)
            means.append(stated.fixed)
            stds.append(stated.std / (stated.fixed if parameters[key].low > 0.0 else 1.0))
    known, batch = len(names), 0 if model.prior is None else len(model.prior.names)
    covariance = np.zeros((known + batch, known + batch))
    covariance[:known, :known] = np.diag(np.square(stds))
    if model.prior is not None:
        if {len(model.prior.covariance), *map(len, model.prior.covariance)} != {batch}:
            raise ValueError(f"covariance: needs {batch} rows of {batch} numbers, one per name")
        covariance[known:, known:] = model.prior.covariance
        names, means = names + model.prior.names, means + model.prior.mean
    return ModelClass(
        tuple(effects),
        tuple(exact),
        tuple(names),
        tuple(means),
        tuple(tuple(map(float, row)) for row in covariance),
    )


def model_hash(model: schema.ModelSettings) -> str:
    """Short hash of a model's content, independent of the place of its files."""
    plain = model.model_dump(mode="json")
    for entry in plain["effects"]:
        if entry["sha256"]:
            entry["effect"] = entry["effect"].replace("\\", "/").rpartition("/")[2]
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:12]
