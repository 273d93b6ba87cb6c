"""An emulated prototype: drives, motors, the plant behind them."""
