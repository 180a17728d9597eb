// bench label: clicks that a simulated person needs, by what it is asked, and how long the answers take.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>

#include "app/bench/bench_studies.h"
#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "core/text.h"
#include "studies/label_bench.h"
#include "system/files.h"
#include "system/shared_files.h"

namespace semfield::app {

namespace {

constexpr int kKills = 200;

std::vector<Acquisition> questions_of(const std::vector<std::string>& names) {
  std::vector<Acquisition> out;
  const auto& known = ChoiceNames<Acquisition>::names;
  for (const std::string& name : names)
    out.push_back(static_cast<Acquisition>(std::find(known.begin(), known.end(), name) - known.begin()));
  return out;
}

}  // namespace

int bench_label(const BenchLabelOptions& options, AppContext& context) {
  LabelBenchOptions bench;
  if (!options.questions.empty()) bench.strategies = questions_of(options.questions);
  bench.seeds = options.seeds;
  bench.most_clicks = options.clicks;
  bench.geometry_s = options.geometry_s;
  const int lost = count_lost_clicks(kKills);  // forks, so before there are threads
  LabelLatency latency;
  std::vector<LabelCourse> courses;
  for (const std::string& file : options.combine) read_label_json(read_text_file(file), file, courses, latency);
  std::vector<std::string> configs = options.configs;
  if (configs.empty() && courses.empty()) configs.push_back(shared_file("configs/quickstart.yaml"));
  const StudyTools tools = study_tools(context);
  const auto load = [&](const std::string& path) {
    RunConfig config = load_run_config(path, options.set, context.registry);
    context.adopt(config);
    return config;
  };
  if (!configs.empty() && options.timed_clicks > 0)
    latency = measure_label_latency(load(configs.front()), options.timed_clicks, options.geometry_s, tools);
  for (const std::string& path : configs) {
    RunConfig config = load(path);
    bench.between_s = options.between_s;
    for (LabelCourse& course : measure_labelling(std::move(config), bench, tools)) courses.push_back(std::move(course));
  }
  if (context.json) {
    print_json(context, Json::parse(label_json(courses, latency)));
    return 0;
  }
  std::printf("%s\n%s\n", label_tables(courses).c_str(), label_line(courses, latency, lost, kKills).c_str());
  return lost == 0 ? 0 : static_cast<int>(ErrorKind::failure);
}

}  // namespace semfield::app
