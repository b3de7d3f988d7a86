# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 2. The digital memcomputing machine on one QUBO
#
# An RBM's state of lowest energy is the solution of a quadratic binary problem (QUBO). The machine (DMM) turns the problem into weighted
# clauses, gives each variable a voltage and each clause two memories, and integrates ordinary differential equations. The memories
# drive the voltages out of local minima; their signs, read now and then, are assignments, and the best of them is kept.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import from_model, from_qubo
from memcomp_lightning.solvers import AlternatingDescent, BranchAndBound, Status
from memcomp_lightning.solvers.dmm import ClauseField, DmmSolver, Recording

rbm = RBM(32, 32, weight_init=Normal(std=0.5), generator=rng.stream(0, "weights"))
with torch.no_grad():
    qubo = from_model(rbm)
clauses = from_qubo(qubo)
print(f"{qubo.n} variables, {len(qubo.graph.edges())} couplings")
print("energy of all zeros:", float(qubo.energy(torch.zeros(1, qubo.n))))

# %% [markdown]
# ## One call
#
# Restarts run side by side; each has a status (stalled: it ended because it had not improved for long). Branch and bound proves what the
# optimum is.

# %%
generator = rng.stream(0, "solver")
DmmSolver(n_restarts=1, max_steps=1).minimise(qubo, generator=generator)  # loads the compiled kernel
solution = DmmSolver(n_restarts=28).minimise(qubo, generator=generator)
proof = BranchAndBound().minimise(qubo, generator=generator)
at_best = int((solution.energies <= solution.best_energy + 1e-4).sum())
print(f"lowest energy {float(solution.best_energy):.5f}, proven optimum {float(proof.best_energy):.5f}")
print(
    f"{at_best} of 28 restarts found it in {1e3 * solution.wall_time_s:.1f} ms; the proof took {proof.wall_time_s:.2f} s"
)
{Status(int(s)).name: int((solution.status == s).sum()) for s in solution.status.unique()}

# %% [markdown]
# ## Its path
#
# Recorded restarts, one after the other: the weight of unsatisfied clauses as the machine moves, the paper's Fig. 2.

# %%
recorded = DmmSolver(n_restarts=10, record=Recording(every=1)).minimise(qubo, generator=generator)
plot_trajectory(recorded.trajectory, title="32x32 RBM, 10 restarts")

# %% [markdown]
# ## Voltages and memories
#
# The vector field by hand: `build` turns a problem into a machine, the integrator makes one step after the other. Short-term memories
# follow whether a clause is satisfied now, long-term memories how long it has not been.

# %%
field = ClauseField()
machine = field.build(clauses)
state = field.init(machine, torch.linspace(-0.5, 0.5, clauses.n).unsqueeze(0))
time, moments, before = [0.0], [state], None
for _ in range(120):
    state, dt, before = field.integrator.step(field, machine, state, before=before)
    time.append(time[-1] + float(dt))
    moments.append(state)

figure, axes = plt.subplots(3, 1, figsize=(7, 6), sharex=True, layout="constrained")
for ax, name in zip(axes, ("voltage", "short_term", "long_term"), strict=True):
    ax.plot(
        time, torch.stack([getattr(moment, name)[0].flatten()[: 5 * 11 : 11] for moment in moments]), linewidth=0.9
    )
    ax.set_ylabel(name.replace("_", "-"))
axes[-1].set_xlabel("machine time (dimensionless)")
plt.show()
energy = [float(qubo.energy((moment.voltage > 0).to(qubo.linear))) for moment in moments]
print(
    f"energy of the signs: {energy[0]:.2f} at the start, {min(energy):.2f} at best, optimum {float(proof.best_energy):.2f}"
)

# %% [markdown]
# ## Restarts, and what they are for
#
# A restart may miss the optimum. The share of restarts that find it says how hard an instance is, and for which solver; here RBMs with
# the same biases and larger and larger couplings, and descent from as many random starts beside the machine.

# %%
shares = {"DMM": [], "descent": []}
sizes = [0.05, 0.1, 0.2, 0.5, 1.0, 2.0]
for std in sizes:
    weights = rng.stream(1, "weights")
    other = RBM(32, 32, weight_init=Normal(std=std), generator=weights)
    with torch.no_grad():
        for bias in (other.b, other.c):
            bias.normal_(std=0.3, generator=weights)
        problem = from_model(other)
        found = {
            name: solver.minimise(problem, generator=generator)
            for name, solver in {
                "DMM": DmmSolver(n_restarts=100),
                "descent": AlternatingDescent(n_restarts=100),
            }.items()
        }
    best = min(float(answer.best_energy) for answer in found.values())
    for name, answer in found.items():
        shares[name].append(float((answer.energies <= best + 1e-4).float().mean()))
for name, share in shares.items():
    plt.semilogx(sizes, share, marker="o", label=name)
plt.xlabel("standard deviation of the couplings")
plt.ylabel("share of restarts at the best energy")
plt.legend()
plt.show()
