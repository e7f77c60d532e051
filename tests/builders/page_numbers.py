"""The numbers that the script of a page decodes."""

import base64

import numpy as np


def numbers(page, script: str) -> np.ndarray:
    """The float32 numbers that a script gives."""
    text = page.evaluate(
        f"""(async () => {{
            const {{kind}} = await wlm, bytes = new Uint8Array((await ({script})).buffer.slice(0));
            let text = '';
            for (let i = 0; i < bytes.length; i += 8192) text += String.fromCharCode(...bytes.subarray(i, i + 8192));
            return btoa(text);
        }})()"""
    )
    return np.frombuffer(base64.b64decode(text), np.float32)
