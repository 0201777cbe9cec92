"""Mathematics that knows no mission: attitudes, LQR, PID gains, turbulence, rigid bodies and distances."""
