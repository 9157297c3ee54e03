"""Contract that import-linter lacks: an allowlist of imports; its own kinds are blocklists."""

from __future__ import annotations

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, fields, output
from importlinter.application import contract_utils
from importlinter.domain import helpers


class AllowanceContract(Contract):
    """Modules, and the modules of the root packages that they import, import only allowed packages from outside.

    The packages that contain a module count as imported, because Python runs their `__init__` first.

    Options:
        source_modules: Modules to start from, each with its submodules.
        allowed: Names of allowed packages, those of the standard library included.
        ignore_imports: Exceptions for one place each, `importer -> imported`.
    """

    type_name = "allowance"

    source_modules = fields.ListField(subfield=fields.ModuleExpressionField())
    allowed = fields.SetField(subfield=fields.StringField())
    ignore_imports = fields.SetField(subfield=fields.ImportExpressionField(), required=False)

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """Follow the imports from the sources; `verbose` changes nothing."""
        contract_utils.remove_ignored_imports_and_report(
            graph=graph,
            ignore_imports=self.ignore_imports,  # type: ignore[arg-type]
            unmatched_alerting=contract_utils.AlertLevel.ERROR,
        )
        sources = helpers.module_expressions_to_modules(graph, self.source_modules, as_packages=True)  # type: ignore[arg-type]
        waiting = sorted(module.name for module in sources)
        ways: dict[str, tuple[str, ...]] = {name: (name,) for name in waiting}
        refused = []
        while waiting:
            name = waiting.pop()
            parent = name.rpartition(".")[0]
            for imported in sorted(graph.find_modules_directly_imported_by(name) | ({parent} if parent else set())):
                if graph.is_module_squashed(imported):
                    if imported not in self.allowed:  # type: ignore[operator]
                        refused.append((*ways[name], imported))
                elif imported not in ways:
                    ways[imported] = (*ways[name], imported)
                    waiting.append(imported)
        return ContractCheck(kept=not refused, metadata={"refused": refused})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """Print each path from a source to a forbidden import."""
        for way in sorted(check.metadata["refused"]):
            output.print_error(" -> ".join(way), bold=False)
        output.new_line()
