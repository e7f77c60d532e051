"""The cascaded lighting volume around a viewer (gaussian-probe-compression, section 3.4)."""
