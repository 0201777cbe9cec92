"""What a page that the program writes may do: show itself, and nothing else."""

from __future__ import annotations

import base64
import hashlib


def content_policy(*, style: str, script: str | None = None, connect: str = "'none'") -> str:
    """Content security policy of a page with one `<style>` and, if it has any, one `<script>`.

    Both are named by their digests, so that no words of a user can become a style or a script,
    whatever they look like; nothing comes from elsewhere, and nothing goes there. The texts must
    stand between their tags to the letter.

    Parameters
    ----------
    style, script : contents of the two elements; without a script, none runs
    connect : whom the script may talk to, as the policy names it
    """
    allowed = {
        "default-src": "'none'",
        "style-src": _digest(style),
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if script is not None:
        allowed |= {
            "script-src": _digest(script),
            "connect-src": connect,
            # Text cannot be made into mark-up by any script either.
            "require-trusted-types-for": "'script'",
            "trusted-types": "'none'",
        }
    return "; ".join(f"{what} {who}" for what, who in allowed.items())


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
