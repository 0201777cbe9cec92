"""Content security policy of generated pages: they may show themselves, and nothing else."""

from __future__ import annotations

import base64
import hashlib


def content_policy(*, style: str, script: str | None = None, connect: str = "'none'") -> str:
    """Content security policy of a page with one `<style>` and, if it has any, one `<script>`.

    The policy names both by their digests, so that no text of a user can become a style or a script.
    Nothing is loaded from elsewhere or sent elsewhere. The texts must stand between their tags exactly
    as given.

    Parameters
    ----------
    style, script : contents of the two elements; without a script, none runs
    connect : hosts that the script may connect to, as the policy names them
    """
    allowed = {
        "default-src": "'none'",
        "style-src": _policy_digest(style),
        "img-src": "data:",
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    if script is not None:
        allowed |= {
            "script-src": _policy_digest(script),
            "connect-src": connect,
            # No script can turn text into markup, either.
            "require-trusted-types-for": "'script'",
            "trusted-types": "'none'",
        }
    return "; ".join(f"{what} {who}" for what, who in allowed.items())


def _policy_digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
