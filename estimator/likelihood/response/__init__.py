"""Mean response of the rotor to a force, and its second-order correction beside nonlinear laws."""
