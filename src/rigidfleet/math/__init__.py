"""Mathematics independent of missions: attitudes, LQR, PID gains, turbulence, rigid bodies and distances."""
