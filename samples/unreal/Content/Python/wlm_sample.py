"""Makes the level of the sample, or opens it, and puts the hours of the day into the menu Wlm. See README.md."""

import math
import runpy
from pathlib import Path

import unreal

ROOT = Path(__file__).resolve().parents[2]
LEVEL = "/Game/Sample"
HOURS = [0.5 * step for step in range(12, 41)]
LIGHT = {}
SMOKE = {}


def start():
    """Waits for the first frame of the editor, before which nothing can be imported."""

    def once(_seconds):
        unreal.unregister_slate_post_tick_callback(waiting)
        main()

    waiting = unreal.register_slate_post_tick_callback(once)


def main():
    """Imports the light with the scripts of the kits, opens the level and shows 8 h."""
    LIGHT.update(runpy.run_path(str(ROOT / "Light" / "wlm_lightmap.py")))
    SMOKE.update(runpy.run_path(str(ROOT / "Smoke" / "wlm_smoke.py")))
    SMOKE["billboard"] = SMOKE["instance"]("MI_Smoke", unreal.load_asset(SMOKE["PLACE"] + "/M_Smoke"), None)
    levels = unreal.get_editor_subsystem(unreal.LevelEditorSubsystem)
    if unreal.EditorAssetLibrary.does_asset_exist(LEVEL):
        levels.load_level(LEVEL)
    else:
        levels.new_level(LEVEL)
        make_room()
        make_smoke()
        levels.save_current_level()
    # Unreal's x, y and z are x, z and y of glTF, in centimetres.
    view = unreal.Vector(0.0, 560.0, 150.0), unreal.Rotator(roll=0.0, pitch=0.0, yaw=-90.0)
    unreal.get_editor_subsystem(unreal.UnrealEditorSubsystem).set_level_viewport_camera_info(*view)
    make_menu()
    show(8.0)


def make_room():
    """Imports the room and gives each of its slots a material under the lightmaps."""
    (mesh,) = LIGHT["imported"]("../room.glb", unreal.StaticMesh)
    LIGHT["prepare"](mesh, LIGHT["UV_SET"])
    lit = unreal.load_asset(LIGHT["PLACE"] + "/M_Lit")
    for number, slot in enumerate(mesh.get_editor_property("static_materials")):
        old = slot.get_editor_property("material_interface")
        mesh.set_material(number, LIGHT["instance"](f"MI_Room_{number}", lit, old))
    unreal.EditorAssetLibrary.save_loaded_asset(mesh)
    place(mesh, unreal.Vector(0.0, 0.0, 0.0), unreal.Rotator(0.0, 0.0, 0.0))


def make_smoke():
    """Puts the smoke on a square of a metre that faces the camera; its top row is v = 0."""
    square = unreal.load_asset("/Engine/BasicShapes/Plane")
    actor = place(square, unreal.Vector(90.0, 150.0, 80.0), unreal.Rotator(roll=90.0, pitch=0.0, yaw=0.0))
    actor.static_mesh_component.set_material(0, SMOKE["billboard"])


def place(mesh, position, rotation):
    """Adds an actor with a mesh to the level."""
    actors = unreal.get_editor_subsystem(unreal.EditorActorSubsystem)
    return actors.spawn_actor_from_object(mesh, position, rotation)


def make_menu():
    """Adds an entry for each half hour to the menu Wlm."""
    menus = unreal.ToolMenus.get()
    menu = menus.find_menu("LevelEditor.MainMenu").add_sub_menu("Wlm", "", "Wlm", "Wlm")
    for hour in HOURS:
        entry = unreal.ToolMenuEntry(name=f"hour_{hour}", type=unreal.MultiBlockType.MENU_ENTRY)
        entry.set_label(f"{int(hour)}:{int(hour % 1 * 60):02}")
        command = f"import wlm_sample; wlm_sample.show({hour})"
        entry.set_string_command(unreal.ToolMenuStringCommandType.PYTHON, "", command)
        menu.add_menu_entry("Hours", entry)
    menus.refresh_all_widgets()


def show(hour):
    """Shows the room at an hour from 6 to 20, and the smoke under a sun of that hour."""
    LIGHT["set_hour"](hour)
    # The sun goes from the east, x, over the room to the west; after 18 h the lamp lights the smoke from above.
    turn, day = math.pi * (hour - 6.0) / 12.0, hour < 18.0
    toward = (math.cos(turn), 0.6, math.sin(turn)) if day else (0.0, 0.1, 1.0)
    length = math.sqrt(sum(each * each for each in toward))
    strength = math.pi * (1.5 * math.sin(turn) if day else 0.4)
    values = {
        "Toward": [each / length for each in toward],
        "Irradiance": [strength] * 3,
        "Sky": [0.07, 0.1, 0.17] if day else [0.01, 0.007, 0.005],
    }
    library = unreal.MaterialEditingLibrary
    for name, (x, y, z) in values.items():
        colour = unreal.LinearColor(x, y, z, 0.0)
        library.set_material_instance_vector_parameter_value(SMOKE["billboard"], name, colour)
    library.update_material_instance(SMOKE["billboard"])
