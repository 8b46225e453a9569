"""Functions that the notebook on the differentiable model gives to JAX: one element of the matrix, fits, densities."""

from __future__ import annotations

import functools

import blackjax
import jax
import jax.numpy as jnp
import optax
import optimistix

ARM = 2  # camera O2: the first of the two that measure u


def m32(instrument, x, y, wavelength):
    """Cross-talk from q into u_m at a field point (deg), in one wavelength (µm)."""
    matrix = instrument.mueller(x, y, wavelength)[ARM]
    return matrix[1, 1] / matrix[0, 0]


def m32_of_plate(thickness, x, y, wavelength, instrument):
    """The same for a thickness (µm) of the MgF2 plate of the second half."""
    return m32(instrument.changed("half2.plate.mgf2", thickness=thickness), x, y, wavelength)


def retardance(quartz, mgf2, instrument, wavelength):
    """Retardance (deg) of the plate of the second half at normal incidence, for two thicknesses (µm)."""
    built = instrument.changed("half2.plate.quartz", thickness=quartz)
    built = built.changed("half2.plate.mgf2", thickness=mgf2)
    return built.element("half2.plate").retardance(0.0, 0.0, wavelength)


def m32_of_values(values, x, y, wavelength, forward):
    """The same for the vector of all parameters."""
    return m32(forward.instrument(values), x, y, wavelength)


def fisher(forward, values):
    """JᵀJ of the free parameters: residuals and priors."""
    jacobian = jax.jit(jax.jacfwd(forward_rows))(values[forward.free], forward)
    return jacobian.T @ jacobian


def forward_rows(free, forward):
    """Residuals of the data and rows of the priors: half of their sum of squares is −ln of the posterior density."""
    values, (index, mean, width) = forward.full(free), forward.prior
    return jnp.concatenate([forward.residuals(values), (values[index] - mean) / width])


def density(steps, forward, centre, root):
    """ln of the posterior density at `centre + root @ steps`, free parameters."""
    return forward.log_density(forward.full(centre + root @ steps))


def student_density(steps, forward, centre, root, degrees=4.0):
    """The same with residuals distributed as Student's t: outliers count little."""
    values = forward.full(centre + root @ steps)
    residuals = forward.residuals(values)
    log_t = -0.5 * (degrees + 1.0) * jnp.log1p(residuals**2 / degrees)
    return jnp.sum(log_t) + forward.log_prior(values)


def least_squares(forward, start, scale):
    """The minimum by Levenberg-Marquardt of optimistix; values of the free parameters, and the number of steps."""

    def rows(steps, forward):
        return forward_rows(start + scale * steps, forward)

    solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    solution = optimistix.least_squares(rows, solver, jnp.zeros(len(start)), args=forward)
    return start + scale * solution.value, int(solution.stats["num_steps"])


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def maximised(log_density, solver, steps, forward, centre, root):
    """The maximum of a density by a solver of optax (Adam, L-BFGS), and ln of the density ahead of every step."""

    def loss(at):
        return -log_density(at, forward, centre, root)

    def step(state, _):
        at, memory = state
        value, gradient = jax.value_and_grad(loss)(at)
        update, memory = solver.update(gradient, memory, at, value=value, grad=gradient, value_fn=loss)
        return (optax.apply_updates(at, update), memory), -value

    zero = jnp.zeros(len(centre))
    (at, _), history = jax.lax.scan(step, (zero, solver.init(zero)), length=steps)
    return centre + root @ at, history


def nuts(forward, centre, root, draws, seed=0, step_size=0.5):
    """Draws of the free parameters by the NUTS of blackjax, acceptance, and leaps of a draw."""

    @jax.jit
    def run(forward, key):
        kernel = blackjax.nuts(lambda z: density(z, forward, centre, root), step_size, jnp.ones(len(centre)))

        def step(state, key):
            state, info = kernel.step(key, state)
            return state, (state.position, info.acceptance_rate, info.num_integration_steps)

        return jax.lax.scan(step, kernel.init(jnp.zeros(len(centre))), jax.random.split(key, draws))[1]

    position, acceptance, leaps = run(forward, jax.random.key(seed))
    return centre + position @ root.T, float(acceptance.mean()), float(leaps.mean())


def numpyro_model(forward, centre, root):
    """The model in numpyro: standard normals, and a factor that makes of them the posterior."""
    import numpyro
    import numpyro.distributions as dist

    steps = numpyro.sample("steps", dist.Normal().expand([len(centre)]).to_event(1))
    free = numpyro.deterministic("free", centre + root @ steps)
    # The density of `steps` is taken out again: what is left is that of the posterior.
    numpyro.factor("posterior", forward.log_density(forward.full(free)) + 0.5 * jnp.sum(steps**2))


def numpyro_draws(forward, centre, root, draws, seed=0):
    """Draws of the free parameters by the NUTS of numpyro."""
    from numpyro.infer import MCMC, NUTS

    sampler = MCMC(NUTS(numpyro_model, step_size=0.35), num_warmup=100, num_samples=draws, progress_bar=False)
    sampler.run(jax.random.key(seed), forward, centre, root)
    return sampler.get_samples()["free"]
