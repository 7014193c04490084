"""Classical controllers: pure pursuit, Stanley, LQR and PID."""
