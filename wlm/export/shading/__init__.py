"""Translates the GLSL of exported models into other shading languages."""

from wlm.export.shading.node import custom_node
from wlm.export.shading.translation import ENDINGS, LANGUAGES, check_language, translate

__all__ = ["ENDINGS", "LANGUAGES", "check_language", "custom_node", "translate"]
