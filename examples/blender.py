"""Opens a movie of meshes in Blender and draws a frame of it:

    warpflag export runs/zipping --to usd --mesh -o movie.usdc
    blender --background --python examples/blender.py -- movie.usdc frame.png 150

or with Blender as a Python package (pip install bpy): python examples/blender.py movie.usdc frame.png 150

Import by hand: File > Import > Universal Scene Description, with scale 1 and "apply unit conversion" off. What is left
to do then is what this script does: the frame rate, and for colours that follow a quantity (--color) an attribute node.
"""

from __future__ import annotations

import argparse
import sys

import bpy  # pyright: ignore[reportMissingImports]

FRAMES_PER_SECOND = 50  # of a movie, unless it was exported with --fps


def open_movie(path: str) -> None:
    """Opens a movie in an empty scene: a Blender unit is a micrometre, and a frame one of the record."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=path, scale=1.0, apply_unit_conversion_scale=False, set_frame_range=True)
    scene = bpy.context.scene
    scene.render.fps = FRAMES_PER_SECOND
    scene.camera = next(thing for thing in bpy.data.objects if thing.type == "CAMERA")
    scene.camera.data.clip_end = 1000.0
    light(scene)
    for material in bpy.data.materials:
        if material.name.startswith("FlagellaMaterial"):
            show_display_color(material)


def light(scene: bpy.types.Scene) -> None:
    """A pale background that lights everything, and the movie's key light as strong as Blender needs it."""
    scene.world = bpy.data.worlds.new("Pale")
    scene.world.use_nodes = True
    background = scene.world.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (0.75, 0.82, 0.9, 1.0)
    background.inputs["Strength"].default_value = 0.8
    for sun in (thing.data for thing in bpy.data.objects if thing.type == "LIGHT"):
        sun.energy = 3.0


def show_display_color(material: bpy.types.Material) -> None:
    """Lets a material show the colour attribute that the meshes bring, which the import leaves unconnected."""
    nodes = material.node_tree.nodes
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = "displayColor"
    surface = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    material.node_tree.links.new(color.outputs["Color"], surface.inputs["Base Color"])


def draw(path: str, frame: int, width: int) -> None:
    """Draws a frame as a picture."""
    scene = bpy.context.scene
    scene.frame_set(frame)
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 16
    scene.cycles.use_denoising = False
    camera = scene.camera.data
    scene.render.resolution_x = width
    scene.render.resolution_y = round(width * camera.sensor_height / camera.sensor_width)
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def main() -> None:
    after = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("movie", help="a .usdc, .usda or .usdz file exported with --mesh")
    parser.add_argument("picture", help="a .png file")
    parser.add_argument("frame", nargs="?", type=int, default=0)
    parser.add_argument("--width", type=int, default=640, help="of the picture [pixels]")
    options = parser.parse_args(after)
    open_movie(options.movie)
    draw(options.picture, options.frame, options.width)


if __name__ == "__main__":
    main()
