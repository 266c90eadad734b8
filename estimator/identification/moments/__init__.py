"""The paper's own methods: Fokker-Planck density, score matching, Volterra series."""
