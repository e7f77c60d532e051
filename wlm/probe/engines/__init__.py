"""Light probes as the files of three.js, Godot, Unity and Unreal."""
