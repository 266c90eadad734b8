"""Mean response of the rotor to a push, and its second-order correction beside nonlinear laws."""
