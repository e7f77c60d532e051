"""Exports light probes to the files of three.js, Godot, Unity, Unreal and Bevy."""
