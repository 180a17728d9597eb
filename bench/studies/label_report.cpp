// What simulated persons needed, as tables, as a line and as JSON.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <nlohmann/json.hpp>

#include "studies/label_bench.h"

namespace semfield {

namespace {

std::string name_of(Acquisition how) {
  return std::string(ChoiceNames<Acquisition>::names[static_cast<std::size_t>(how)]);
}

// INFINITY for a course that never got there; of none at all NAN.
double median(std::vector<double> values) {
  if (values.empty()) return NAN;
  std::sort(values.begin(), values.end());
  const std::size_t half = values.size() / 2;
  return values.size() % 2 == 1 || std::isinf(values[half]) ? values[half] : (values[half - 1] + values[half]) / 2;
}

std::vector<double> clicks_of(const std::vector<LabelCourse>& courses, Acquisition how, double level,
                              const std::string& scene = {}) {
  std::vector<double> out;
  for (const LabelCourse& course : courses) {
    if (course.how != how || (!scene.empty() && course.scene != scene)) continue;
    const std::optional<int> clicks = course.clicks_to(level);
    out.push_back(clicks ? *clicks : INFINITY);
  }
  return out;
}

std::string clicks_text(double clicks, int most) {
  if (std::isnan(clicks)) return "n/a";
  return std::isinf(clicks) ? fmt::format(">{}", most) : fmt::format("{:.0f}", clicks);
}

std::string ratio_text(double ours, double random, int most) {
  if (std::isnan(ours) || std::isnan(random) || std::isinf(ours)) return "n/a";
  return std::isinf(random) ? fmt::format("<{:.2f}", ours / most) : fmt::format("{:.2f}", ours / random);
}

std::vector<std::string> scenes_of(const std::vector<LabelCourse>& courses) {
  std::vector<std::string> out;
  for (const LabelCourse& course : courses)
    if (std::find(out.begin(), out.end(), course.scene) == out.end()) out.push_back(course.scene);
  return out;
}

std::vector<double> all_of(const std::vector<LabelCourse>& courses,
                           const std::function<std::vector<double>(const LabelCourse&)>& values) {
  std::vector<double> out;
  for (const LabelCourse& course : courses) {
    const std::vector<double> more = values(course);
    out.insert(out.end(), more.begin(), more.end());
  }
  return out;
}

int longest(const std::vector<LabelCourse>& courses) {
  std::size_t most = 0;
  for (const LabelCourse& course : courses) most = std::max(most, course.miou.size());
  return static_cast<int>(most);
}

std::string latency_text(double ms) { return std::isnan(ms) ? "n/a" : fmt::format("{:.0f}", ms); }

double percentile(std::vector<double> values, double share) {
  if (values.empty()) return NAN;
  std::sort(values.begin(), values.end());
  return values[std::min(values.size() - 1, static_cast<std::size_t>(share * static_cast<double>(values.size())))];
}

}  // namespace

std::string label_tables(const std::vector<LabelCourse>& courses) {
  const int most_clicks = longest(courses);
  std::string text =
      "| scene | question | clicks to 0.5 | to 0.6 | to 0.7 | mIoU after 30 | after 100 | classes after 30 | ECE | "
      "with "
      "temperature |\n|---|---|---|---|---|---|---|---|---|---|\n";
  for (const std::string& scene : scenes_of(courses)) {
    for (std::size_t h = 0; h < ChoiceNames<Acquisition>::names.size(); ++h) {
      const auto how = static_cast<Acquisition>(h);
      std::vector<double> after30, after100, classes30, before, after;
      for (const LabelCourse& course : courses) {
        if (course.how != how || course.scene != scene) continue;
        if (course.miou.size() >= 30) after30.push_back(course.miou[29]);
        if (course.miou.size() >= 100) after100.push_back(course.miou[99]);
        if (course.classes.size() >= 30) classes30.push_back(course.classes[29]);
        before.push_back(course.ece_before);
        after.push_back(course.ece_after);
      }
      if (before.empty()) continue;
      text += fmt::format("| {} | {} |", scene, name_of(how));
      for (const double level : kLabelLevels) {
        const std::vector<double> clicks = clicks_of(courses, how, level, scene);
        const auto [least, most] = std::minmax_element(clicks.begin(), clicks.end());
        text += fmt::format(" {} ({} to {}) |", clicks_text(median(clicks), most_clicks),
                            clicks_text(*least, most_clicks), clicks_text(*most, most_clicks));
      }
      text += fmt::format(" {:.3f} | {:.3f} | {:.0f} | {:.3f} | {:.3f} |\n", median(after30), median(after100),
                          median(classes30), median(before), median(after));
    }
  }
  return text;
}

std::string label_line(const std::vector<LabelCourse>& courses, const LabelLatency& latency, int lost, int kills) {
  const int most_clicks = longest(courses);
  const auto clicks = [&](Acquisition how, double level) { return median(clicks_of(courses, how, level)); };
  const double ours60 = clicks(Acquisition::surface, 0.6), random60 = clicks(Acquisition::random, 0.6);
  const double proposal = percentile(
      all_of(
          courses,
          [](const LabelCourse& c) { return c.how == Acquisition::surface ? c.proposal_ms : std::vector<double>{}; }),
      0.5);
  return fmt::format(
      "label: clicks60_ours={} clicks60_random={} clicks60_entropy={} ratio60={} ratio70={} proposal_ms={} "
      "overlay_p50_ms={} overlay_p95_ms={} lost_clicks={}/{} slowdown={}",
      clicks_text(ours60, most_clicks), clicks_text(random60, most_clicks),
      clicks_text(clicks(Acquisition::entropy, 0.6), most_clicks), ratio_text(ours60, random60, most_clicks),
      ratio_text(clicks(Acquisition::surface, 0.7), clicks(Acquisition::random, 0.7), most_clicks),
      latency_text(proposal), latency_text(percentile(latency.overlay_ms, 0.5)),
      latency_text(percentile(latency.overlay_ms, 0.95)), lost, kills,
      latency.overlay_ms.empty() ? "n/a" : fmt::format("{:.2f}", latency.slowdown));
}

std::string label_json(const std::vector<LabelCourse>& courses, const LabelLatency& latency) {
  nlohmann::ordered_json out{{"overlay_ms", latency.overlay_ms}, {"slowdown", latency.slowdown}};
  for (const LabelCourse& course : courses) {
    out["courses"].push_back({{"scene", course.scene},
                              {"question", name_of(course.how)},
                              {"seed", course.seed},
                              {"miou", course.miou},
                              {"classes", course.classes},
                              {"proposal_ms", course.proposal_ms},
                              {"learn_ms", course.learn_ms},
                              {"ece", course.ece_before},
                              {"ece_with_temperature", course.ece_after},
                              {"temperature", course.temperature}});
  }
  return out.dump();
}

void read_label_json(const std::string& text, const std::string& name, std::vector<LabelCourse>& courses,
                     LabelLatency& latency) {
  try {
    const nlohmann::json read = nlohmann::json::parse(text);
    if (!read.at("overlay_ms").empty())
      latency = {read.at("overlay_ms").get<std::vector<double>>(), read.at("slowdown").get<double>()};
    for (const nlohmann::json& one : read.value("courses", nlohmann::json::array())) {
      LabelCourse course;
      course.scene = one.at("scene");
      const auto& names = ChoiceNames<Acquisition>::names;
      const auto how = std::find(names.begin(), names.end(), one.at("question").get<std::string>());
      if (how == names.end())
        throw Error(ErrorKind::data, "study.result.damaged", name + ": it names a question that does not exist");
      course.how = static_cast<Acquisition>(how - names.begin());
      course.seed = one.at("seed");
      course.miou = one.at("miou").get<std::vector<double>>();
      course.classes = one.at("classes").get<std::vector<int>>();
      course.proposal_ms = one.at("proposal_ms").get<std::vector<double>>();
      course.learn_ms = one.at("learn_ms").get<std::vector<double>>();
      course.ece_before = one.at("ece");
      course.ece_after = one.at("ece_with_temperature");
      course.temperature = one.at("temperature");
      courses.push_back(std::move(course));
    }
  } catch (const nlohmann::json::exception& error) {
    throw Error(ErrorKind::data, "study.result.damaged",
                name + ": it is no result of `semfield-study label --json`: " + error.what(), "write it again");
  }
}

}  // namespace semfield
