// label: clicks that a simulated person needs, by what it is asked, and how long the answers take.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>

#include "app/bench/bench_tools.h"
#include "app/json_output.h"
#include "app/verb.h"
#include "core/text.h"
#include "studies/label_bench.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct LabelStudyOptions {
  std::vector<std::string> configs;
  std::vector<std::string> set;
  std::vector<std::string> questions;
  int seeds = 5;
  int clicks = 300;
  double geometry_s = 30;
  double between_s = 2;
  int timed_clicks = 60;
  std::vector<std::string> combine;
};

constexpr int kKills = 200;

std::vector<Acquisition> questions_of(const std::vector<std::string>& names) {
  std::vector<Acquisition> out;
  const auto& known = ChoiceNames<Acquisition>::names;
  for (const std::string& name : names)
    out.push_back(static_cast<Acquisition>(std::find(known.begin(), known.end(), name) - known.begin()));
  return out;
}

int run(const LabelStudyOptions& options, AppContext& context) {
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

void words(VerbWords& verb, LabelStudyOptions& options) {
  verb.optional_operands("config", options.configs, "configurations of labelled scenes (default: the shipped room)");
  verb.repeated("--set KEY=VALUE", options.set, "override a value: --set train.rays=2048");
  verb.threads(options.set);
  verb.device(options.set);
  verb.list("--questions LIST", options.questions, "ways to ask, with commas (default: all)",
            choice_names<Acquisition>());
  verb.value_in("--seeds N", options.seeds, 1, 100,
                "persons for each way to ask; the first one's seed is runtime.seed");
  verb.value_in("--clicks N", options.clicks, 1, 2000, "clicks of a person");
  verb.positive("--geometry X", options.geometry_s, "seconds of training before the first click");
  verb.value_in("--between X", options.between_s, 0, 86400,
                "seconds of training between two clicks; 0: the geometry stands");
  verb.value_in("--timed-clicks N", options.timed_clicks, 0, 1000,
                "clicks whose answers are timed while a session trains");
  verb.list("--combine FILES", options.combine,
            "files that `--json` has written; their persons count as if they were here");
}

}  // namespace

Verb verb_label() {
  return with_json(make_verb<LabelStudyOptions>(
      "label", 50, "count the clicks that a simulated person needs, and time the answers", words, run));
}

}  // namespace semfield::app
