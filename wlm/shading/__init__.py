"""Shader text: what the systems' GLSL has in common, and the same text in other languages."""

from wlm.shading.node import custom_node
from wlm.shading.translation import ENDINGS, LANGUAGES, check_language, translate

__all__ = ["ENDINGS", "LANGUAGES", "check_language", "custom_node", "translate"]
