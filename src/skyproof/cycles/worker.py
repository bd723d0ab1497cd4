# SPDX-License-Identifier: GPL-3.0-or-later
# Copyright (C) 2026 The skyproof developers
#
# This one file runs inside Blender and uses its Python interface, which is under the GNU General
# Public License; so is this file: you can redistribute it and change it under the terms of that
# licence, version 3 or, at your choice, any later version. It comes WITHOUT ANY WARRANTY. The
# licence: https://www.gnu.org/licenses/gpl-3.0.html
#
# It imports nothing of skyproof, and skyproof does not import it: they exchange files. The rest of
# skyproof is under the Apache License 2.0.
"""Runs inside Blender: reads job files, path-traces each crop, writes arrays.

Started as `python worker.py SCRATCH` with bpy, or as `blender --background --python worker.py --
SCRATCH`. Every line of standard input names a job file (.npz) and the file for its result (.npy),
separated by a tab. Lines for skyproof begin with `skyproof-worker` on standard output, because
Blender prints there too.
"""

import json
import math
import os
import struct
import sys
from pathlib import Path
from typing import Any, TextIO

import bpy
import numpy as np
from mathutils import Matrix, Vector

MARK = "skyproof-worker"
# Metres; the ground ends there. Far larger than a crop, so that only light near the horizon
# differs.
GROUND_HALF_WIDTH_M = 300.0
CAMERA_DISTANCE_M = 60.0
CHANNELS = [f"Combined.{channel}" for channel in "RGBA"] + [
    f"Shadow Catcher.{channel}" for channel in "RGB"
]


class Stage:
    """A Blender scene with ground, sun, sky and camera; every job adds its vehicles."""

    def __init__(self, scratch: Path) -> None:
        self.picture = scratch / f"{os.getpid()}.exr"
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self._set_up_rendering()
        self.ground_place, self.ground_image = self._ground()
        self.sky_image = self._sky()
        self.sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
        self.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
        self.camera.data.type = "ORTHO"
        self.camera.data.clip_end = 2 * CAMERA_DISTANCE_M
        # An object's own matrix holds no shear; the one between it and its parent may.
        self.camera.parent = bpy.data.objects.new("camera parent", None)
        for each in (self.sun, self.camera, self.camera.parent):
            self.scene.collection.objects.link(each)
        self.scene.camera = self.camera

    def render(self, job: dict[str, Any], arrays: dict[str, np.ndarray]) -> np.ndarray:
        """Returns a crop, `[H, W, 7]`: colour times coverage, coverage, the ground's light left."""
        self._point_camera(job)
        self._light(job, arrays["sky"])
        self._texture_ground(job, arrays["ground"])
        self.scene.cycles.samples, self.scene.cycles.seed = job["samples"], job["seed"]
        made: list[Any] = []
        try:
            for index in range(len(arrays["vertices"])):
                made += self._vehicle(index, arrays)
            bpy.ops.render.render(write_still=True)
            return read_exr(self.picture)
        finally:
            bpy.data.batch_remove(made)
            self.picture.unlink(missing_ok=True)

    def _set_up_rendering(self) -> None:
        scene, cycles = self.scene, self.scene.render
        cycles.engine = "CYCLES"
        cycles.film_transparent = True
        cycles.threads_mode, cycles.threads = "FIXED", 1
        # Kept data would be stale after a change of seed or samples.
        cycles.use_persistent_data = False
        cycles.resolution_percentage = 100
        cycles.filepath = str(self.picture)
        cycles.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        cycles.image_settings.color_depth, cycles.image_settings.exr_codec = "32", "NONE"
        scene.view_settings.view_transform = "Standard"
        scene.view_layers[0].cycles.use_pass_shadow_catcher = True
        settings = {
            "device": "CPU",
            "use_adaptive_sampling": False,
            "use_denoising": False,
            "use_auto_tile": False,
            # The mean over a pixel's area, as the differentiable renderer takes it.
            "pixel_filter_type": "BOX",
            "max_bounces": 4,
            "diffuse_bounces": 3,
            "glossy_bounces": 3,
            "transmission_bounces": 0,
            "caustics_reflective": False,
            # In units of a sunlit white surface: the mirrored sun is cut here, or blurred it would
            # hide half a vehicle.
            "sample_clamp_direct": 5.0,
            "sample_clamp_indirect": 5.0,
        }
        for name, value in settings.items():
            setattr(scene.cycles, name, value)

    def _ground(self) -> tuple[Any, Any]:
        """Adds a matt plane that shows only by the light it exchanges with vehicles."""
        half = GROUND_HALF_WIDTH_M
        mesh = bpy.data.meshes.new("ground")
        corners = [(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)]
        mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
        plane = bpy.data.objects.new("ground", mesh)
        plane.is_shadow_catcher = True
        self.scene.collection.objects.link(plane)
        material = bpy.data.materials.new("ground")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        nodes.clear()
        output = nodes.new("ShaderNodeOutputMaterial")
        matt = nodes.new("ShaderNodeBsdfDiffuse")
        image = nodes.new("ShaderNodeTexImage")
        place = nodes.new("ShaderNodeNewGeometry")
        scale = nodes.new("ShaderNodeMapping")
        image.extension, image.interpolation = "EXTEND", "Linear"
        links.new(place.outputs["Position"], scale.inputs["Vector"])
        links.new(scale.outputs["Vector"], image.inputs["Vector"])
        links.new(image.outputs["Color"], matt.inputs["Color"])
        links.new(matt.outputs["BSDF"], output.inputs["Surface"])
        mesh.materials.append(material)
        return scale, image

    def _sky(self) -> Any:
        world = bpy.data.worlds.new("sky")
        self.scene.world = world
        world.use_nodes = True
        # A smooth sky needs no importance map, and without one every thread count gives the same
        # bytes.
        world.cycles.sampling_method = "NONE"
        image = world.node_tree.nodes.new("ShaderNodeTexEnvironment")
        world.node_tree.links.new(
            image.outputs["Color"], world.node_tree.nodes["Background"].inputs["Color"]
        )
        return image

    def _point_camera(self, job: dict[str, Any]) -> None:
        """Adds a parallel camera whose pixels lie on the ground as an orthophoto's do."""
        left, top, width, height = job["window_px"]
        gsd_m, render = job["gsd_m"], self.scene.render
        middle = (left + width / 2 - job["size_px"] / 2, job["size_px"] / 2 - top - height / 2)
        render.resolution_x, render.resolution_y = width, height
        self.camera.data.ortho_scale = max(width, height) * gsd_m
        shear = np.eye(4)
        shear[:3, 2] = job["viewer"]
        shear[:2, 3] = np.array(middle) * gsd_m
        shear[:3, 3] += np.array(job["viewer"]) * CAMERA_DISTANCE_M
        self.camera.matrix_parent_inverse = Matrix(shear.tolist())

    def _light(self, job: dict[str, Any], sky: np.ndarray) -> None:
        light, irradiance = self.sun.data, job["sun_irradiance"]
        # Energy times colour is the irradiance across the rays.
        light.energy = max(irradiance)
        light.angle = job["sun_diameter_rad"]
        light.color = [value / max(light.energy, 1e-9) for value in irradiance]
        self.sun.hide_render = light.energy == 0
        self.sun.rotation_euler = Vector(job["sun"]).to_track_quat("Z", "Y").to_euler()
        replace_image(self.sky_image, sky)

    def _texture_ground(self, job: dict[str, Any], ground: np.ndarray) -> None:
        height, width = ground.shape[:2]
        left, top = job["ground_origin_px"]
        gsd_m, half = job["gsd_m"], job["size_px"] / 2
        # Metres to the image's own coordinates, which run from its lower left corner to its upper
        # right one.
        wide_m, high_m = width * gsd_m, height * gsd_m
        left_m, low_m = (left - half) * gsd_m, (half - top - height) * gsd_m
        place = self.ground_place.inputs
        place["Scale"].default_value = (1 / wide_m, 1 / high_m, 1.0)
        place["Location"].default_value = (-left_m / wide_m, -low_m / high_m, 0.0)
        replace_image(self.ground_image, ground)

    def _vehicle(self, index: int, arrays: dict[str, np.ndarray]) -> list[Any]:
        """Its mesh, material and images, which are removed after the picture."""
        faces, face_uvs = arrays["faces"], arrays["uvs"][arrays["face_uvs"]]
        mesh = bpy.data.meshes.new("vehicle")
        mesh.vertices.add(len(arrays["vertices"][index]))
        mesh.vertices.foreach_set("co", arrays["vertices"][index].astype(np.float32).ravel())
        mesh.loops.add(faces.size)
        mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
        mesh.polygons.add(len(faces))
        mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
        mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), dtype=bool))
        # Row 0 of our maps is at v = 0; Blender's images begin at the bottom, and so do the arrays
        # handed over.
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", face_uvs.astype(np.float32).ravel())
        mesh.update(calc_edges=True)
        material, images = self._surface(
            arrays["textures"][index], arrays["labels"][index], arrays["materials"]
        )
        mesh.materials.append(material)
        vehicle = bpy.data.objects.new("vehicle", mesh)
        self.scene.collection.objects.link(vehicle)
        return [vehicle, mesh, material, *images]

    def _surface(
        self, texture: np.ndarray, labels: np.ndarray, table: np.ndarray
    ) -> tuple[Any, list[Any]]:
        """One material from maps: colour; roughness, coat, specular level, the coat's roughness."""
        material = bpy.data.materials.new("vehicle")
        material.use_nodes = True
        nodes, links = material.node_tree.nodes, material.node_tree.links
        surface = nodes["Principled BSDF"]
        colour = nodes.new("ShaderNodeTexImage")
        finish = nodes.new("ShaderNodeTexImage")
        for node, interpolation in ((colour, "Linear"), (finish, "Closest")):
            node.interpolation, node.extension = interpolation, "REPEAT"
        colour.image = new_image(linear(texture).transpose(1, 2, 0))
        finish.image = new_image(table[labels])
        parts = nodes.new("ShaderNodeSeparateColor")
        links.new(colour.outputs["Color"], surface.inputs["Base Color"])
        links.new(finish.outputs["Color"], parts.inputs["Color"])
        links.new(parts.outputs["Red"], surface.inputs["Roughness"])
        links.new(parts.outputs["Green"], surface.inputs["Coat Weight"])
        links.new(parts.outputs["Blue"], surface.inputs["Specular IOR Level"])
        links.new(finish.outputs["Alpha"], surface.inputs["Coat Roughness"])
        return material, [colour.image, finish.image]


def linear(texture: np.ndarray) -> np.ndarray:
    """sRGB bytes to linear light."""
    value = np.arange(256) / 255
    table = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[texture]


def new_image(values: np.ndarray) -> Any:
    """A float image of unchanged `[H, W, 3 or 4]` values, the first row at the bottom."""
    height, width, channels = values.shape
    image = bpy.data.images.new("values", width, height, alpha=True, float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    # Otherwise the fourth channel would scale the colour.
    image.alpha_mode = "CHANNEL_PACKED"
    pixels = np.ones((height, width, 4), dtype=np.float32)
    pixels[..., :channels] = values
    image.pixels.foreach_set(pixels.ravel())
    return image


def replace_image(node: Any, values: np.ndarray) -> None:
    """Puts values, the first row at the top, into a node."""
    # New pixels need a new image: Blender would serve the old one's again.
    old = node.image
    node.image = new_image(values[::-1])
    if old is not None:
        bpy.data.images.remove(old)


def read_exr(path: Path) -> np.ndarray:
    """Reads the needed channels of an uncompressed multilayer OpenEXR file, as `[H, W, 7]`.

    Blender gives no access to a multilayer file's pixels. Layout:
    https://openexr.com/en/latest/OpenEXRFileLayout.html
    """
    data = path.read_bytes()
    place, header = 8, {}
    while data[place]:
        name_end = data.index(b"\0", place)
        kind_end = data.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<i", data, kind_end + 1)
        header[data[place:name_end].decode()] = data[kind_end + 5 : kind_end + 5 + size]
        place = kind_end + 5 + size
    names, entry = [], 0
    while header["channels"][entry]:
        end = header["channels"].index(b"\0", entry)
        names.append(header["channels"][entry:end].decode().partition(".")[2])
        entry = end + 17
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    # After the header: an offset of 8 bytes per line, then the lines, each with its number and its
    # size before it.
    start = place + 1 + 8 * height
    line = 8 + 4 * width * len(names)
    lines = np.frombuffer(data, np.uint8, height * line, start).reshape(height, line)[:, 8:]
    values = np.ascontiguousarray(lines).view("<f4").reshape(height, len(names), width)
    return np.stack([values[:, names.index(name)] for name in CHANNELS], axis=-1)


def say(out: TextIO, **message: Any) -> None:
    """Prints one line for skyproof."""
    print(MARK, json.dumps(message), file=out, flush=True)


def main() -> None:
    """Works until standard input ends."""
    scratch = Path(sys.argv[-1])
    # Blender's own messages go nowhere; ours keep the way out.
    out = os.fdopen(os.dup(1), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    say(out, version=list(bpy.app.version))
    stage = Stage(scratch)
    for line in sys.stdin:
        job_file, result = map(Path, line.rstrip("\n").split("\t"))
        try:
            with np.load(job_file, allow_pickle=False) as stored:
                arrays = dict(stored)
            rendered = stage.render(json.loads(str(arrays.pop("job"))), arrays)
            if not math.isfinite(float(rendered.sum())):
                raise ValueError("the picture holds values that are not finite")
            partial = result.with_name(f".{result.name}.{os.getpid()}.partial")
            with open(partial, "wb") as file:
                np.save(file, rendered)
            os.replace(partial, result)
        except Exception as error:  # skyproof hears of any error and goes on
            say(out, failed=str(result), why=f"{type(error).__name__}: {error}")
        else:
            say(out, done=str(result))


if __name__ == "__main__":
    main()
