// bench quadrature: every rule of the rendering integral on media whose integrals are known.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>

#include "quadrature_report.h"
#include "system/files.h"
#include "verbs.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

QuadratureResults measure(const BenchQuadratureOptions& options, AppContext& context) {
  QuadratureResults results;
  results.problems = quadrature_problems();
  results.rules = quadrature_rules(context.registry);
  results.rays = options.rays;
  QuadratureOptions how;
  how.rays = options.rays;
  for (const RayProblem& problem : results.problems) {
    print_note(context, problem.name);
    for (const QuadratureRule& rule : results.rules) {
      results.curves.push_back(measure_rule<double>(problem, rule, how, context.registry));
      results.curves.push_back(measure_rule<float>(problem, rule, how, context.registry));
    }
  }
  print_note(context, "stiff media and thin slabs");
  for (const QuadratureRule& rule : results.rules) {
    for (const StiffRow& row : measure_stiffness(rule, options.rays, context.registry)) results.stiff.push_back(row);
    for (const ThinSlabRow& row : measure_thin_slabs(rule, 8 * options.rays, context.registry))
      results.thin.push_back(row);
  }
  return results;
}

}  // namespace

int run_bench_quadrature(const BenchQuadratureOptions& options, AppContext& context) {
  if (!options.out.empty()) {
    std::error_code failed;
    fs::create_directories(options.out, failed);
    if (failed)
      throw Error(ErrorKind::cannot_create, options.out + ": cannot create the folder: " + failed.message(),
                  "choose another --out");
  }
  const QuadratureResults results = measure(options, context);
  const std::string text = quadrature_tables(results) + "\n## Omissions\n\n" + quadrature_omissions(results);
  if (!options.out.empty()) {
    const fs::path folder = options.out;
    write_file_atomic((folder / "tables.md").string(), text);
    write_file_atomic((folder / "quadrature.json").string(), quadrature_json(results));
    for (const RayProblem& problem : results.problems)
      write_file_atomic((folder / (problem.key + ".svg")).string(), quadrature_figure(results, problem));
  }
  if (context.json) {
    std::printf("%s\n", quadrature_json(results).c_str());
    return 0;
  }
  const OrderCount orders = count_orders(results);
  std::printf("%s\nbench quadrature: rules=%zu problems=%zu order_ok=%d/%d\n", text.c_str(), results.rules.size(),
              results.problems.size(), orders.held, orders.compared);
  return orders.held == orders.compared ? 0 : static_cast<int>(ErrorKind::failure);
}

}  // namespace semfield::app
