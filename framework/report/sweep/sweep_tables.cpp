#include "report/sweep/sweep_tables.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>

#include "config/params_read.h"
#include "core/check.h"
#include "formats/text_rows.h"
#include "report/report_svg.h"

namespace semfield {

namespace {

// Upper tail P(T > t) of Student's t by its finite series in theta = atan(t / sqrt(v)) [Abramowitz64, 26.7.3-26.7.4].
double t_upper_tail(double t, int v) {
  const double theta = std::atan(t / std::sqrt(static_cast<double>(v)));
  const double s = std::sin(theta), c = std::cos(theta);
  double term = v % 2 == 1 ? c : 1, sum = v == 1 ? 0 : term;
  for (int k = v % 2 == 1 ? 3 : 2; k <= v - 2; k += 2) {
    term *= c * c * (k - 1) / k;
    sum += term;
  }
  const double inside = v % 2 == 1 ? 2 / M_PI * (theta + s * sum) : s * sum;  // P(-t < T < t)
  return (1 - inside) / 2;
}

std::string cell_text(const MeanInterval& m) {
  if (m.n == 0) return "–";
  if (m.half_width > 0) return fmt::format("{:.3f} ± {:.3f}", m.mean, m.half_width);
  return fmt::format("{:.3f}", m.mean);
}

// What a reader calls a metric of metrics.jsonl.
std::string metric_label(const std::string& metric) {
  static const std::map<std::string, std::string> labels{
      {"miou_present", "mIoU"},
      {"given_miou_present", "mIoU of the labels given"},
      {"total_accuracy", "accuracy"},
      {"given_total_accuracy", "accuracy of the labels given"},
      {"psnr", "PSNR, dB"},
      {"absrel", "AbsRel"},
      {"ece", "ECE"},
      {"nll", "NLL, nats"},
      {"entropy_auroc", "AUROC of entropy, wrong pixels"},
      {"training_miou_present", "mIoU of training frames"},
      {"training_ece", "ECE of training frames"},
      {"training_entropy_auroc", "AUROC of entropy, wrong pixels of training frames"},
      {"given_right_entropy", "entropy where labelled rightly, nats"},
      {"given_wrong_entropy", "entropy where labelled wrongly, nats"},
      {"given_none_entropy", "entropy where unlabelled, nats"},
      {"given_wrong_auroc", "AUROC of entropy, wrong against right labels"},
      {"given_none_auroc", "AUROC of entropy, unlabelled against labelled"},
      {"rmse", "RMSE of depth, m"},
      {"train_s", "seconds of training"},
      {"processor_s", "CPU seconds"},
      {"peak_mb", "peak memory, MB"}};
  const auto found = labels.find(metric);
  return found == labels.end() ? metric : found->second;
}

// A bar would end the table's cell.
std::string md(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (c == '|') out += '\\';
    out += c;
  }
  return out;
}

}  // namespace

double student_t975(int freedom) {
  SEMFIELD_CHECK(freedom >= 1, "no degrees of freedom");
  double low = 1.9, high = 12.8;  // t(1) = 12.7062, t(infinity) = 1.9600
  for (int i = 0; i < 60; ++i) {
    const double middle = (low + high) / 2;
    (t_upper_tail(middle, freedom) > 0.025 ? low : high) = middle;
  }
  return (low + high) / 2;
}

MeanInterval mean_interval(const std::vector<double>& values) {
  MeanInterval out;
  out.n = static_cast<int>(values.size());
  if (values.empty()) return out;
  for (const double v : values) out.mean += v;
  out.mean /= out.n;
  if (out.n < 2) return out;
  double squares = 0;
  for (const double v : values) squares += (v - out.mean) * (v - out.mean);
  out.half_width = student_t975(out.n - 1) * std::sqrt(squares / (out.n - 1) / out.n);
  return out;
}

ExperimentTable::ExperimentTable(const Sweep& sweep, std::size_t experiment, const std::vector<Cell>& cells,
                                 const SweepResults& results)
    : experiment_(sweep.experiments.at(experiment)) {
  scored_.resize(experiment_.scenes.size());
  values_.assign(experiment_.scenes.size(), std::vector<std::vector<const CellValues*>>(experiment_.variants.size()));
  for (const Cell& cell : cells) {
    const auto found = results.find(cell.id);
    if (found == results.end()) continue;
    for (const CellUse& use : cell.uses) {
      if (use.experiment != experiment) continue;
      values_[use.scene][use.variant].push_back(&found->second);
      if (cell.trains()) note_unequal(use, found->second);
    }
  }
}

void ExperimentTable::note_unequal(const CellUse& use, const CellValues& values) {
  for (const char* what : {"frames", "pixels"}) {
    const auto is = [&](const auto& entry) { return entry.first == what; };
    const auto own = std::find_if(values.begin(), values.end(), is);
    if (own == values.end()) continue;  // of versions that did not write it
    CellValues& first = scored_[use.scene];
    const auto others = std::find_if(first.begin(), first.end(), is);
    if (others == first.end()) {
      first.push_back(*own);
    } else if (others->second != own->second && unequal_.empty()) {
      unequal_ = fmt::format("its variants were scored on other {} of the scene '{}': {:.0f}, and {:.0f} by '{}'", what,
                             experiment_.scenes[use.scene].name, others->second, own->second,
                             experiment_.variants[use.variant].name);
    }
  }
}

MeanInterval ExperimentTable::at(std::size_t scene, std::size_t variant, const std::string& metric) const {
  std::vector<double> values;
  for (const CellValues* seed : values_[scene][variant]) {
    for (const auto& [name, value] : *seed) {
      if (name == metric) values.push_back(value);
    }
  }
  return mean_interval(values);
}

MeanInterval ExperimentTable::over_scenes(std::size_t variant, const std::string& metric) const {
  MeanInterval out;
  double squares = 0;
  bool known = true;  // of every scene's interval
  for (std::size_t s = 0; s < values_.size(); ++s) {
    const MeanInterval m = at(s, variant, metric);
    if (m.n == 0) continue;
    ++out.n;
    out.mean += m.mean;
    squares += m.half_width * m.half_width;
    known = known && m.n > 1;
  }
  if (out.n > 0) {
    out.mean /= out.n;
    if (known) out.half_width = std::sqrt(squares) / out.n;
  }
  return out;
}

std::string ExperimentTable::metric_table(const std::string& metric, bool with_paper) const {
  const Experiment& e = experiment_;
  const bool many = e.scenes.size() > 1;
  std::string out = "| " + metric_label(metric) + " |", rule = "|---|";
  const auto column = [&](const std::string& head) {
    out += " " + head + " |";
    rule += "---|";
  };
  for (const SweepScene& scene : e.scenes) column(md(scene.name));
  if (many) column("mean");
  if (with_paper) column("paper" + (e.paper.empty() ? "" : " (" + md(e.paper) + ")"));
  out += "\n" + rule + "\n";
  for (std::size_t v = 0; v < e.variants.size(); ++v) {
    out += "| " + md(e.variants[v].name) + " |";
    for (std::size_t s = 0; s < e.scenes.size(); ++s) out += " " + cell_text(at(s, v, metric)) + " |";
    if (many) out += " " + cell_text(over_scenes(v, metric)) + " |";
    if (with_paper) out += " " + (e.variants[v].paper ? fmt::format("{:.3f}", *e.variants[v].paper) : "–") + " |";
    out += "\n";
  }
  return out;
}

std::string ExperimentTable::markdown() const {
  const Experiment& e = experiment_;
  std::string out = "## " + e.title + "\n\n";
  if (!e.note.empty()) out += e.note + "\n\n";
  const std::size_t seeds = e.seeds.size();
  out += fmt::format("Scored on {} frames; {}.\n", e.split == "train" ? "training" : "held-out",
                     seeds == 1 ? "one seed" : fmt::format("mean of {} seeds ± half the 95 % interval", seeds));
  if (!unequal_.empty()) return out + "\nNot compared: " + md(unequal_) + ".\n";
  bool paper =
      std::any_of(e.variants.begin(), e.variants.end(), [](const SweepVariant& v) { return v.paper.has_value(); });
  for (const std::string& metric : e.metrics) {
    out += "\n" + metric_table(metric, paper);
    paper = false;  // its figures are of the first metric
  }
  return out;
}

std::string ExperimentTable::csv() const {
  const Experiment& e = experiment_;
  std::string out = "variant,scene,metric,n,mean,half_width\n";
  if (!unequal_.empty()) return out;
  for (std::size_t v = 0; v < e.variants.size(); ++v) {
    for (std::size_t s = 0; s < e.scenes.size(); ++s) {
      for (const std::string& metric : e.metrics) {
        const MeanInterval m = at(s, v, metric);
        if (m.n == 0) continue;
        out += csv_field(e.variants[v].name) + "," + csv_field(e.scenes[s].name) + "," + csv_field(metric) + "," +
               std::to_string(m.n) + "," + shortest_number(m.mean) + "," + shortest_number(m.half_width) + "\n";
      }
    }
  }
  return out;
}

std::string ExperimentTable::svg() const {
  if (!unequal_.empty()) return {};
  const Experiment& e = experiment_;
  PlotSpec spec;
  spec.title = e.title + ": " + metric_label(e.metrics.front());
  spec.x_label = e.x_label;
  spec.markers = true;
  std::size_t places = 0;
  for (std::size_t s = 0; s < e.scenes.size(); ++s) {
    PlotSeries series;
    series.name = e.scenes[s].name;
    series.color = static_cast<int>(s % 8);
    for (std::size_t v = 0; v < e.variants.size(); ++v) {
      const MeanInterval m = at(s, v, e.metrics.front());
      if (!e.variants[v].x || m.n == 0) continue;
      PlotPoint point{*e.variants[v].x, m.mean};
      if (m.half_width > 0) {
        point.low = m.mean - m.half_width;
        point.high = m.mean + m.half_width;
      }
      series.points.push_back(point);
    }
    std::sort(series.points.begin(), series.points.end(),
              [](const PlotPoint& a, const PlotPoint& b) { return a.x < b.x; });
    places = std::max(places, series.points.size());
    if (!series.points.empty()) spec.series.push_back(std::move(series));
  }
  return places < 2 ? std::string() : figure_svg(spec.title, {spec}, 1);
}

}  // namespace semfield
