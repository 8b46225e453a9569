"""An instrument that somebody might describe: one arm, a window that turns, a plate of two crystals."""

OWN = """
name = "OWN"
about = "One arm"
path = ["polariser", "window"]
[site]
telescope = "roof"
latitude = 50.0
[field]
limit = 0.2
scale = 0.1
[cameras]
names = ["left", "right"]
[throughput]
degree = 1
level = 0.4
[elements.polariser]
kind = "polariser"
moves = "CLP"
extinction = { value = 1e-4, sigma = 2e-5 }
[elements.window]
kind = "retarder"
moves = "WIN"
delta = { value = 0.1, sigma = 0.02, unit = "rad", source = "a measurement" }
axis = 10.0
[arms.main]
path = ["plate", "analyser"]
[arms.main.elements.plate]
kind = "wave_plate"
axis = 5.0
[[arms.main.elements.plate.layers]]
name = "first"
material = "quartz"
thickness = { value = 51.0, sigma = 1.0, unit = "um" }
[[arms.main.elements.plate.layers]]
name = "second"
material = "mgf2"
axis = { value = 90.0, loose = 2.0 }
thickness = 30.0
[arms.main.elements.analyser]
kind = "analyser"
cameras = ["right", "left"]
efficiency = { value = 0.99, sigma = 0.005, name = "eta" }
"""
