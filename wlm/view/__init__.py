"""Draws originals and decoded light: pictures, contact sheets, and an interactive window."""
