"""The compiled form of the program: numbers in, a `ConeProgram` out.

CVXPY reduces the parametrised program to cones once (DPP). From then on an iteration evaluates that
form, q + A x as a linear map of the parameters, with the sparsity that it was compiled with, so that a
solver can be updated in place. The values go in with the call, so that a compiled program has no state
and can be shared.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from formulations.problem.regions import Array
from formulations.program.certificate import ConeProgram
from formulations.program.model import Model


class CompiledProgram:
    """A model reduced to cones.

    Args:
        model: the program.

    Raises:
        ValueError: if it is not a disciplined parametrised convex program.
    """

    def __init__(self, model: Model) -> None:
        if not model.program.is_dcp(dpp=True):
            raise ValueError("the program is not disciplined convex in its parameters")
        for parameter in model.parameters.values():
            parameter.value = np.zeros(parameter.shape)
        # Clarabel's is the form of every solver of second-order cones: zero, non-negative, then these.
        options = {"use_quad_obj": False}
        data, _, _ = model.program.get_problem_data(
            cp.CLARABEL, canon_backend="COO", solver_opts=options
        )
        self._form: Any = data[cp.settings.PARAM_PROB]
        self._ids = {name: parameter.id for name, parameter in model.parameters.items()}
        first = self._form.var_id_to_col[model.burns.id]
        self._burns = slice(first, first + model.burns.size)
        # Maps of all parameters and 1 to the cost, and to [A b] column by column.
        rows, columns = self._form.constr_size, self._form.x.size
        both, cost = sp.csr_array(self._form.A), sp.csr_array(self._form.q)
        filled = np.flatnonzero(np.diff(both.indptr))
        entries = filled[filled < rows * columns]
        self._cost, self._bound = cost[:columns], both[rows * columns :]
        self._entries = both[entries]
        starts = np.searchsorted(entries, rows * np.arange(columns + 1))
        # QOCO takes 32-bit indices only.
        self._row, self._starts = (entries % rows).astype(np.int32), starts.astype(np.int32)

    def evaluate(self, values: Mapping[str, Array]) -> ConeProgram:
        """The numbers of the program for every parameter's value, by name.

        What `ParamConeProg.apply_parameters` gives, without laying out its sparsity again.
        """
        form = self._form
        by_id = {self._ids[name]: value for name, value in values.items()}
        parameters = np.ones(form.total_param_size + 1)
        for number, value in by_id.items():
            first = form.param_id_to_col[number]
            parameters[first : first + value.size] = value.ravel(order="F")
        shape = form.constr_size, form.x.size
        matrix = sp.csc_array((-(self._entries @ parameters), self._row, self._starts), shape=shape)
        dims = form.cone_dims
        return ConeProgram(
            self._cost @ parameters,
            matrix,
            self._bound @ parameters,
            dims.zero,
            dims.nonneg,
            tuple(dims.soc),
            form,
            by_id,
        )

    def burns(self, x: Array) -> Array:
        """The burns in an answer, shape (m, 3)."""
        return x[self._burns].reshape(-1, 3)
