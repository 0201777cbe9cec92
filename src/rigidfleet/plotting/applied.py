"""Whether our style is applied now: the style sets it, and the renderer, which is below the style, asks."""

from contextvars import ContextVar

applied: ContextVar[bool] = ContextVar("applied", default=False)
