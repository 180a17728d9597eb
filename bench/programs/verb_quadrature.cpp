// quadrature: every rule of the rendering integral on media whose integrals are known.
#include <fmt/format.h>

#include <cstdio>
#include <filesystem>

#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "app/verb.h"
#include "studies/quadrature_report.h"
#include "system/files.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

struct QuadratureStudyOptions {
  long long rays = 1024;  ///< for rules with jitter and media with jumps
  std::string out;        ///< folder for plots, tables and quadrature.json; "": none
};

int run(const QuadratureStudyOptions& options, AppContext& context) {
  if (!options.out.empty()) {
    std::error_code failed;
    fs::create_directories(options.out, failed);
    if (failed)
      throw Error(ErrorKind::cannot_create, "files.output.create",
                  options.out + ": cannot create the folder: " + failed.message(), "choose another --out");
  }
  const QuadratureResults results = measure_quadrature(options.rays, study_tools(context));
  const std::string text = quadrature_tables(results) + "\n## Omissions\n\n" + quadrature_omissions(results);
  if (!options.out.empty()) {
    const fs::path folder = options.out;
    write_file_atomic((folder / "tables.md").string(), text);
    write_file_atomic((folder / "quadrature.json").string(), quadrature_json(results));
    for (const RayProblem& problem : results.problems)
      write_file_atomic((folder / (problem.key + ".svg")).string(), quadrature_figure(results, problem));
  }
  if (context.json) {
    print_json(context, Json::parse(quadrature_json(results)));
    return 0;
  }
  const OrderCount orders = count_orders(results);
  std::printf("%s\nstudy quadrature: rules=%zu problems=%zu order_ok=%d/%d\n", text.c_str(), results.rules.size(),
              results.problems.size(), orders.held, orders.compared);
  return orders.held == orders.compared ? 0 : static_cast<int>(ErrorKind::failure);
}

void words(VerbWords& verb, QuadratureStudyOptions& options) {
  verb.value_in("--rays N", options.rays, 16, 1000000, "number of rays for jittered rules and media with jumps");
  verb.value("--out FOLDER", options.out, "folder for plots (SVG), tables.md and quadrature.json");
}

}  // namespace

Verb verb_quadrature() {
  return with_json(make_verb<QuadratureStudyOptions>(
      "quadrature", 10,
      "measure the error of every sampler rule of the rendering integral, against evaluations and time", words, run));
}

}  // namespace semfield::app
