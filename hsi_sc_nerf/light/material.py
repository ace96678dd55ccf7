"""The irradiance at any point of an object, with its uncertainty, and the materials of its surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from hsi_sc_nerf.light.elements import NORMAL_WEIGHT, Elements, shown_points
from hsi_sc_nerf.light.fit import fit_light
from hsi_sc_nerf.light.known_light import KnownLight
from hsi_sc_nerf.light.material_fit import LEAST_IRRADIANCE, OCCLUSION_ERROR, LightFit, materials_under
from hsi_sc_nerf.light.stationary_light import even_directions
from hsi_sc_nerf.light.views import SMALLEST, ElementViews, TurningElements, transfer

RAY_DIRECTIONS = 4096
"""Number of rays over the sphere: 3.2 degrees apart."""
BAND_GROUPS = 8
"""The light is fitted to this number of means of neighbouring bands: its colours are smooth."""
NEIGHBOURS = 4
"""Number of elements over which the irradiance at a point is averaged."""
LEAST_SIDEWAYS = 0.1
"""Square of the sine between the optical axis and the turntable's: 18 degrees."""
UNEXPLAINED = 2.0
"""Error of irradiance relative to the scatter: the model's errors in single views do not average out."""
CONTACT_ERROR, CONTACT_M = 0.5, 0.0025
"""Relative error of the material at the level surface that the object stands on, and the height over which it falls
by the factor e: pixels also show that surface, and a trained mesh fills the crevice (docs/validation/light.md)."""


@dataclass(frozen=True, eq=False)
class PointMaterial:
    """The material at points, and the light that was taken off.

    Attributes:
        spectra: reflectance of the material.
        irradiance: relative to that on the white reference, mean over the bands.
        irradiance_std: relative to the irradiance, the standard deviation of the material's brightness.
        gloss: what the skin mirrors, as reflectance, mean over the bands; None where no gloss was found.
    """

    spectra: Float[np.ndarray, "n selected"]
    irradiance: Float[np.ndarray, "n"]
    irradiance_std: Float[np.ndarray, "n"]
    gloss: Float[np.ndarray, "n"] | None


@dataclass(frozen=True, eq=False)
class ObjectLight:
    """Irradiance on an object, and its material.

    Attributes:
        elements: elements of the object and its support.
        turning: the elements as they turn under the light.
        views: measurements of them in the frames, without what the skin mirrors.
        fit: the light by groups of bands.
        spectral: the fit's light and materials at the bands of the views.
    """

    elements: Elements
    turning: TurningElements
    views: ElementViews
    fit: LightFit
    spectral: LightFit

    def irradiance(
        self, points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], frames: Int[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "n bands"], Float[np.ndarray, "n"]]:
        """Irradiance at points of the object in one frame each, relative to that on the white reference.

        Args:
            points_m: object frame.
            normals: outward unit normals.
            frames: the frame that measured each point.

        Returns:
            The irradiance, and the standard deviation of its mean over the bands, which for a point just above the
            surface that the object stands on is that of the material times the irradiance.
        """
        of_object = np.flatnonzero(self.elements.on_object)
        positions = self.elements.positions[of_object]
        # The typical distance between neighbouring elements.
        spacing_m = 2.0 * float(np.median(cKDTree(positions).query(positions, 2)[0][:, 1]))
        right_angle_m = NORMAL_WEIGHT * spacing_m / np.sqrt(2.0)
        features = np.concatenate([positions, right_angle_m * self.elements.normals[of_object]], axis=1)
        distance, nearest = cKDTree(features).query(
            np.concatenate([points_m, right_angle_m * normals], axis=1), min(NEIGHBOURS, len(features))
        )
        distance, nearest = distance.reshape(len(points_m), -1), of_object[nearest.reshape(len(points_m), -1)]
        weights = 1.0 / (distance + 0.25 * spacing_m) ** 2
        weights /= weights.sum(axis=1, keepdims=True)
        result = np.empty((len(points_m), self.spectral.material.shape[1]), np.float32)
        for frame in np.unique(frames):
            rows = np.flatnonzero(frames == frame)
            direct = self.turning.direct(self.spectral.light, int(frame))[:, None]
            whole = (direct + self.turning.bounced(direct, self.spectral.material))[:, 0]
            result[rows] = np.einsum("nk,nkb->nb", weights[rows], whole[nearest[rows]])
        result = np.maximum(result, LEAST_IRRADIANCE)
        relative = np.sqrt((weights * self._relative_variance[nearest]).sum(axis=1))
        level = self.elements.shows_light & ~self.elements.on_object
        if level.any():
            above_m = np.maximum(points_m[:, 2] - self.elements.positions[level, 2].mean(), 0.0)
            relative = np.hypot(relative, CONTACT_ERROR * np.exp(-above_m / CONTACT_M))
        return result, relative * result.mean(axis=1)

    def material_at(
        self,
        reflectance: Float[np.ndarray, "n selected"],
        points_m: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        frames: Int[np.ndarray, "n"],
        bands: Int[np.ndarray, "selected"],
    ) -> PointMaterial:
        """The material at points of the object, from what one frame each measured there.

        Args:
            reflectance: as measured.
            points_m: object frame.
            normals: outward unit normals.
            frames: the frame that measured each point.
            bands: of the light, at which the reflectance is given.
        """
        by_band, std = self.irradiance(points_m, normals, frames)
        irradiance, gloss = by_band.mean(axis=1), None
        if self.fit.gloss is not None:
            in_camera = np.einsum("nk,nkj->nj", normals, self.turning.rotations[frames])
            added, added_std = self.fit.gloss.at(in_camera, self.spectral.light)
            gloss, reflectance = added.mean(axis=1), np.maximum(reflectance - added[:, bands], SMALLEST)
            relative = np.nan_to_num(added_std / reflectance.mean(axis=1))  # 0 for a point without a spectrum
            std = np.hypot(std, irradiance * relative)
        return PointMaterial(reflectance / by_band[:, bands], irradiance, std, gloss)

    @property
    def _relative_variance(self) -> Float[np.ndarray, "elements"]:
        """Relative variance of each element's irradiance: of the light, its occluders, and the model's errors."""
        count, views = len(self.elements.positions), np.bincount(self.views.element)
        views = np.pad(views, (0, count - len(views)))
        of_light = np.bincount(self.views.element, self.fit.relative_std**2, count) / np.maximum(views, 1)
        of_light[views == 0] = of_light[views > 0].max()
        occluded = 1.0 - self.turning.transfer.sky
        return of_light + (OCCLUSION_ERROR * occluded) ** 2 + (UNEXPLAINED * self.fit.scatter) ** 2


def centre_in_camera(elements: Elements, camera_to_object: Float[np.ndarray, "frames 4 4"]) -> Float[np.ndarray, "3"]:
    """The object's centre in the camera's frame, metres: the mean over the frames, if it does not lie on the axis."""
    centre_m = elements.positions[elements.on_object].mean(axis=0)
    rotations, eyes_m = camera_to_object[:, :3, :3], camera_to_object[:, :3, 3]
    return np.einsum("fkj,fk->fj", rotations, centre_m - eyes_m).mean(axis=0)


def white_place(
    centre_m: Float[np.ndarray, "3"], camera_to_object: Float[np.ndarray, "frames 4 4"], height_m: float | None
) -> Float[np.ndarray, "3"]:
    """Where the white reference was captured, on the turntable's axis: relative to the object, in the camera's frame.

    Args:
        centre_m: the object's centre, camera's frame.
        camera_to_object: poses of the frames, metres.
        height_m: over the disc; None for where the camera's optical axis passes that of the turntable. A camera that
            looks down along it shows no such height, and gives the object's centre.
    """
    eyes_m, forward = camera_to_object[:, :3, 3], -camera_to_object[:, :3, 2]
    if height_m is None:
        sideways = (forward[:, :2] ** 2).sum(axis=1)
        if sideways.mean() < LEAST_SIDEWAYS:
            return np.zeros(3)
        along_m = -(eyes_m[:, :2] * forward[:, :2]).sum(axis=1) / sideways
        height_m = float(np.median(eyes_m[:, 2] + along_m * forward[:, 2]))
    on_axis_m = np.array([0.0, 0.0, height_m])
    return np.einsum("fkj,fk->fj", camera_to_object[:, :3, :3], on_axis_m - eyes_m).mean(axis=0) - centre_m


def turning_elements(
    elements: Elements, rotations: Float[np.ndarray, "frames 3 3"], pixel_m: float, lift_m: float
) -> TurningElements:
    """Cast the rays of the elements.

    Args:
        elements: elements of the object and its support.
        rotations: camera-to-object rotation of each frame.
        pixel_m: radius of the area around an element that a pixel shows.
        lift_m: distance of the rays' origins from the surface.
    """
    directions = even_directions(RAY_DIRECTIONS)
    points, normals, weights = shown_points(elements, pixel_m, lift_m)
    faces = elements.of_triangle, len(elements.positions)
    seen = transfer(points, normals, elements.occluders, *faces, directions, lift_m).mean(weights)
    centre_m = elements.positions[elements.on_object].mean(axis=0)
    return TurningElements(
        elements.positions - centre_m, elements.normals, elements.on_object, seen, directions, rotations
    )


def light_on_object(
    elements: Elements,
    turning: TurningElements,
    views: ElementViews,
    white_normal: Float[np.ndarray, "3"],
    known: KnownLight | None = None,
    white_m: Float[np.ndarray, "3"] | None = None,
) -> ObjectLight:
    """Fit the light to groups of bands, and interpolate it to all bands.

    Args:
        elements: elements of the object and its support.
        turning: the elements as they turn under the light.
        views: measurements of them in the frames.
        white_normal: outward unit normal of the white reference, camera's frame.
        known: light that is taken as it is, at the object's centre and the bands of the views. Only the materials are
            found.
        white_m: place of the white reference relative to the object's centre, camera's frame; None for that centre.
    """
    bands = views.reflectance.shape[1]
    groups = np.array_split(np.arange(bands), min(BAND_GROUPS, bands))
    means = np.stack([views.reflectance[:, group].mean(axis=1) for group in groups], axis=-1)
    grouped = replace(views, reflectance=means)
    if known is None:
        fit = fit_light(turning, grouped, white_normal, white_m)
    else:
        of_chamber, of_lamps = (
            np.array([colour[group].mean() for group in groups])
            for colour in (known.light.chamber_colour, known.light.lamp_colour)
        )
        light = replace(known.light, chamber_colour=of_chamber, lamp_colour=of_lamps)
        fit = materials_under(light, known.covariance, turning, grouped)
    at = np.array([group.mean() for group in groups])
    # Linear between the groups' middles, constant beyond the outermost.
    between = np.stack([np.interp(np.arange(bands), at, column) for column in np.eye(len(at))], axis=-1)
    light = fit.light
    light = replace(light, chamber_colour=between @ light.chamber_colour, lamp_colour=between @ light.lamp_colour)
    irradiance = fit.irradiance @ between.T
    entries = fit.weights, (views.element, np.arange(len(views.element)))
    weighted = scipy.sparse.csr_array(entries, shape=(len(elements.positions), len(views.element)))
    if fit.gloss is not None:
        matte = fit.gloss.taken_off(views.reflectance, turning.normals_in_camera(views), light)
        views = replace(views, reflectance=np.where(views.on_object[:, None], matte, views.reflectance))
    above, below = weighted @ (views.reflectance * irradiance), weighted @ irradiance**2
    seen = below[:, 0] > 0.0
    material = np.clip(above / np.maximum(below, 1e-9), 1e-4, 1.0)
    material[~seen] = material[seen][cKDTree(elements.positions[seen]).query(elements.positions[~seen])[1]]
    spectral = replace(fit, light=light, material=material, irradiance=irradiance)
    return ObjectLight(elements, turning, views, fit, spectral)
