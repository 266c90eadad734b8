"""The folder of this file is on the import path: helpers that several folders share lie beside it."""
