#include "eval/report/tune.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <filesystem>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>
#include <set>
#include <tuple>

#include "config/settings/choices.h"
#include "config/settings/run_config.h"
#include "core/error.h"
#include "core/text.h"
#include "train/metrics_log.h"

namespace semfield {

using Json = nlohmann::ordered_json;

namespace {

constexpr std::array kParts{1., 0.5, 0.25, 0.125, 0.0625};  // of the full length that rounds may have
constexpr int kHoldOut = 8;
constexpr double kMostScored_px = 4e5;    // paired cells score the same pixels, and all of them cost more than training
constexpr std::size_t kMostTogether = 6;  // values that are combined
// Shares of the time by whose end a round ends, if it can; of the first three, those of what the full length leaves.
constexpr double kAloneUntil = 0.7, kTogetherUntil = 0.9, kFullUntil = 0.85, kOutUntil = 0.94;
constexpr double kMostForFull = 0.45;   // of the time
constexpr double kLeastTrusted = 0.45;  // of the full length: what trains less tells little of what parts are worth
constexpr std::size_t kFewTrusted = 4;  // that long, rather than many that mislead

const std::vector<TuneAim> kAims{{"psnr", "psnr", "dB", 0.05, 2},
                                 {"miou", "miou_present", "mIoU", 0.005, 3},
                                 {"depth", "absrel", "AbsRel", 0.001, 3},
                                 {"time", "train_s", "% of the time", 1, 0}};

std::optional<double> value_of(const CellValues& values, const std::string& metric) {
  for (const auto& [name, value] : values)
    if (name == metric) return value;
  return std::nullopt;
}

// More is better; a gain of time is a share of it.
std::optional<double> score_of(const CellValues& values, const TuneAim& aim) {
  const std::optional<double> value = value_of(values, aim.metric);
  if (!value) return value;
  return aim.name == "time" ? -100 * std::log(*value) : aim.name == "depth" ? -*value : *value;
}

// "position.levels" of passes.main.position.levels, "rays" of train.rays.
std::string short_key(const std::string& key) {
  const std::size_t skip = key.starts_with("passes.") ? key.find('.', 7) : key.find('.');
  return skip == std::string::npos ? key : key.substr(skip + 1);
}

std::string type_of(const ConfigNode& item) {
  const ConfigNode* type = item.find("type");
  return type != nullptr ? type->text() : "";
}

// losses.TYPE.KEY: the item of that type, which is added where there is none; losses.TYPE without a value: none of it.
void set_loss(ConfigNode& config, const ConfigOverride& over) {
  const std::vector<std::string_view> words = parts_of(over.key, '.');
  const std::string type(words[1]);
  const ConfigNode* old = config.given("losses");
  std::vector<ConfigNode> items = old != nullptr && old->is_list() ? old->items() : std::vector<ConfigNode>();
  const auto found = std::find_if(items.begin(), items.end(), [&](const ConfigNode& i) { return type_of(i) == type; });
  if (words.size() == 2) {
    if (found != items.end()) items.erase(found);
  } else {
    ConfigNode& item = found != items.end() ? *found : items.emplace_back(ConfigNode::make_map({}, {}));
    item.set("type", ConfigNode::make_scalar(type, false, over.value.location()));
    item.set_path(over.key.substr(words[0].size() + type.size() + 2), over.value);
  }
  config.set("losses", ConfigNode::make_list(std::move(items), over.value.location()));
}

bool names_loss(const std::string& key) {
  const std::vector<std::string_view> words = parts_of(key, '.');
  return words.size() > 1 && words[0] == "losses" && !to_number<std::size_t>(words[1]);
}

}  // namespace

const TuneAim& tune_aim(const std::string& name) {
  const auto found = std::find_if(kAims.begin(), kAims.end(), [&](const TuneAim& aim) { return aim.name == name; });
  return found == kAims.end() ? kAims.front() : *found;
}

std::vector<std::string> tune_aims() {
  std::vector<std::string> names;
  for (const TuneAim& aim : kAims) names.push_back(aim.name);
  return names;
}

// The space.

std::vector<TuneAxis> read_tune_space(const std::string& path) {
  const ConfigNode root = compose_config(path);
  Diagnostics diagnostics;
  const auto error = [&](const Location& at, const std::string& message) {
    diagnostics.error("tune.space.value", at.text(), message, "write axes: {train.rays: [1024, 4096]}");
  };
  for (const auto& [key, node] : root.entries())
    if (key != "axes") error(node.key_location(), "unknown key '" + key + "'");
  std::vector<TuneAxis> axes;
  const ConfigNode* const map = root.find("axes");
  if (map == nullptr || map->entries().empty())
    error((map == nullptr ? root : *map).location(), "axes: expected a map of key paths to values, or of variants");
  for (const auto& [name, node] : map != nullptr ? map->entries() : std::vector<ConfigNode::Entry>()) {
    if (node.is_null()) continue;  // an axis of an included file that is not wanted
    TuneAxis axis{name, {}};
    for (const ConfigNode& value : node.items())
      axis.values.push_back({short_key(name) + " " + write_config_inline(value), {{name, value}}});
    for (const auto& [variant, set] : node.entries())
      noting(diagnostics, set.location().text(), [&] {
        axis.values.push_back({variant, overrides_of(set, "axes." + name + "." + variant)});
      });
    if (axis.values.empty())
      error(node.location(), "axes." + name + ": expected a list of values of this key, or a map of variants");
    axes.push_back(std::move(axis));
  }
  diagnostics.throw_if_errors(ErrorKind::config, "");
  return axes;
}

std::vector<TuneAxis> optional_parts(const ConfigNode& config) {
  std::vector<TuneAxis> parts;
  const auto add = [&](const std::string& what, const std::string& key, ConfigNode without) {
    parts.push_back({what, {{"without " + what, {{key, std::move(without)}}}}, true});
  };
  if (const ConfigNode* losses = config.given("losses"); losses != nullptr)
    for (const ConfigNode& loss : losses->items())
      if (!type_of(loss).empty())
        add("the loss " + type_of(loss), "losses." + type_of(loss), ConfigNode::make_null({}));
  for (const char* what : {"poses", "colors"}) {
    const std::string key = std::string("train.cameras.") + what;
    if (const ConfigNode* trust = config.given(key); trust != nullptr && trust->text() != "given")
      add(std::string("corrections of ") + what, key, ConfigNode::make_scalar("given", false, {}));
  }
  if (const ConfigNode* passes = config.given("passes"); passes != nullptr)
    for (std::size_t i = 0; i < passes->items().size(); ++i)
      if (passes->items()[i].given("semantic") != nullptr)
        add("the branch for semantics", "passes." + item_key(*passes, i) + ".semantic", ConfigNode::make_null({}));
  return parts;
}

ConfigNode with_choice(const TunePlan& plan, const TuneChoice& choice) {
  ConfigNode config = plan.config;
  for (std::size_t i = 0; i < choice.size(); ++i) {
    if (choice[i] < 0) continue;
    for (const ConfigOverride& over : plan.axes[i].values[static_cast<std::size_t>(choice[i])].set) {
      if (names_loss(over.key)) {
        set_loss(config, over);
      } else {
        set_values(config, {over});
      }
    }
  }
  return config;
}

std::string choice_name(const std::vector<TuneAxis>& axes, const TuneChoice& choice) {
  std::vector<std::string> names;
  for (std::size_t i = 0; i < choice.size(); ++i)
    if (choice[i] >= 0) names.push_back(axes[i].values[static_cast<std::size_t>(choice[i])].name);
  return names.empty() ? "as configured" : join(names);
}

Cell tune_cell(const TunePlan& plan, const TuneChoice& choice, double length, int seed, Registry& registry) {
  RunConfig run = run_config_of(with_choice(plan, choice), registry);
  run.base_dir = std::filesystem::absolute(plan.path).parent_path().lexically_normal().string();
  run.name = std::filesystem::path(plan.path).stem().string();
  run.runtime.seed += static_cast<std::uint32_t>(seed);
  ask(run, plan.in_steps ? AskedLength{std::llround(length), 0} : AskedLength{0, length});
  if (run.load.hold_out == 0) run.load.hold_out = kHoldOut;
  run.report.eval_share = 0;  // every candidate is scored on the same pixels
  run.report.eval_stride = plan.score_stride;
  run.report.eval_every_s = 0;
  run.report.strips = run.report.worst_frames = run.report.training_frames = 0;
  Cell cell;
  cell.config = write_config(resolved_config(run));
  cell.split = "test" + kSampleSuffix;
  cell.scene = run.name;
  cell.label = choice_name(plan.axes, choice);
  cell.seed = run.runtime.seed;
  cell.id = id_of_cell(cell);
  return cell;
}

int score_stride_for(const TunePlan& plan, const CellValues& scored) {
  const double pixels = value_of(scored, "pixels").value_or(0);
  return static_cast<int>(std::ceil(plan.score_stride * std::max(1.0, std::sqrt(pixels / kMostScored_px))));
}

// The race.

namespace {

class Race {
 public:
  Race(const TunePlan& plan, TuneWork& work)
      : axes_(plan.axes), plan_(plan), work_(work), aim_(tune_aim(plan.aim)), base_(axes_.size(), -1) {}

  TuneOutcome run() {
    out_.best = second_ = base_;
    out_.whole = configured() && alone() && together() && around() && full() && leave_out();
    out_.noise = noise(aim_);
    return std::move(out_);
  }

 private:
  static TuneChoice with(TuneChoice choice, std::size_t axis, int value) {
    choice[axis] = value;
    return choice;
  }
  // In which they differ.
  static std::size_t axis_of(const TuneChoice& a, const TuneChoice& b) {
    return static_cast<std::size_t>(std::mismatch(a.begin(), a.end(), b.begin()).first - a.begin());
  }

  double whole(double length) const { return plan_.in_steps ? std::max(1.0, std::round(length)) : length; }
  // Of the cells that have not been trained yet.
  double cost_s(const std::vector<TuneChoice>& candidates, int seeds, double length) const {
    std::set<Known> cells;
    for (const TuneChoice& candidate : candidates)
      for (int seed = 0; seed < seeds; ++seed) cells.insert({candidate, length, seed});
    const auto is_new = std::count_if(cells.begin(), cells.end(), [&](const Known& k) { return !known_.contains(k); });
    return std::ceil(static_cast<double>(is_new) / plan_.at_a_time) * (work_.cell_s() + length * unit_s_);
  }
  double left_s(double until) const { return until * plan_.time_s - work_.spent_s(); }
  // Short trainings favour what learns at once, so the winner has to show itself at the full length.
  double search_until(double part) const {
    const double full_s = std::ceil(2.0 / plan_.at_a_time) * (work_.cell_s() + plan_.length * unit_s_);
    return part * (kFullUntil - std::min(1.05 * full_s / plan_.time_s, kMostForFull));
  }
  // As many of the first candidates as possible, `fewest` at least, that end in time; then all seeds, or one, and the
  // longest training from `least` to `most`. No candidates: there is no time.
  TuneRound fit(const std::string& name, const std::vector<TuneChoice>& candidates, double least, double most,
                double until, std::size_t fewest) {
    for (std::vector<TuneChoice> some = candidates; some.size() >= fewest; some.pop_back())
      for (const int seeds : {plan_.seeds, 1})
        for (const double part : kParts) {
          const double length = whole(part * plan_.length);
          if (length < least || length > most || cost_s(some, seeds, length) > left_s(until)) continue;
          if (some.size() < candidates.size())
            note(fmt::format("time for {} of {} in the round '{}'", some.size() - 1, candidates.size() - 1, name));
          return {name, length, seeds, std::move(some)};
        }
    return {name, 0, 1, {}};
  }
  // The same with half of the candidates; where they have no time, with two, of any length.
  TuneRound fit(const std::string& name, const std::vector<TuneChoice>& candidates, double least, double most,
                double until) {
    TuneRound half{};
    if (least > 0) half = fit(name, candidates, least, most, until, std::max<std::size_t>(2, candidates.size() / 2));
    return half.candidates.empty() ? fit(name, candidates, 0, most, until, 2) : half;
  }
  void note(const std::string& text) { out_.notes.push_back(text); }

  // False: stopped. A round without candidates is left out, and the one before stays the last.
  bool round(const TuneRound& wanted) {
    TuneRound agreed = work_.agreed(wanted);
    skipped_ = agreed.candidates.empty();
    if (skipped_) note(fmt::format("no time for the round '{}'", agreed.name));
    if (skipped_) return true;
    std::optional<TuneScores> scores = work_.run(agreed);
    if (!scores) return false;
    out_.rounds.push_back({std::move(agreed), std::move(*scores)});
    double all_s = 0;
    for (std::size_t c = 0; c < last().candidates.size(); ++c) {
      all_s += step_s(c);
      for (int seed = 0; seed < last().seeds; ++seed) known_.insert({last().candidates[c], last().length, seed});
    }
    for (const TuneAim& aim : kAims) learn_noise(aim);
    if (plan_.in_steps && all_s > 0) unit_s_ = all_s / static_cast<double>(last().candidates.size());
    return true;
  }
  const TuneRound& last() const { return out_.rounds.back().first; }
  const TuneScores& scores() const { return out_.rounds.back().second; }

  // Of each seed of the last round's candidate over the first one; fewer than seeds where one did not score.
  std::vector<double> gains(const TuneAim& aim, std::size_t candidate) const {
    std::vector<double> out;
    for (std::size_t s = 0; s < scores()[candidate].size(); ++s) {
      const auto own = score_of(scores()[candidate][s], aim), first = score_of(scores()[0][s], aim);
      if (own && first) out.push_back(*own - *first);
    }
    return out;
  }
  TuneGain gain(const TuneAim& aim, std::size_t candidate) const {
    const std::vector<double> all = gains(aim, candidate);
    if (std::ssize(all) < last().seeds) return {-std::numeric_limits<double>::infinity(), 0, last().seeds};
    const auto sure = std::count_if(all.begin(), all.end(), [](double g) { return g > 0; });
    return {mean_interval(all).mean, static_cast<int>(sure), last().seeds};
  }

  // Twice the standard error of a mean of paired gains, its variance pooled over the candidates of the last round that
  // had several seeds.
  void learn_noise(const TuneAim& aim) {
    double squares = 0, freedom = 0;
    for (std::size_t c = 1; c < last().candidates.size(); ++c) {
      const std::vector<double> all = gains(aim, c);
      const double mean = mean_interval(all).mean;
      for (const double g : all) squares += (g - mean) * (g - mean);
      freedom += std::max(0.0, static_cast<double>(all.size()) - 1);
    }
    if (freedom > 0) noise_[aim.name] = 2 * std::sqrt(squares / freedom / last().seeds);
  }
  double noise(const TuneAim& aim) const {
    const auto found = noise_.find(aim.name);
    return found == noise_.end() ? 2 * aim.least_noise : std::max(aim.least_noise, found->second);
  }
  // What a part may cost that goes: where seeds differ much, little is known.
  double slight() const { return std::min(noise(aim_), 4 * aim_.least_noise); }
  // PSNR or mIoU falls by more than its noise, or is not there any more.
  bool harms(std::size_t candidate) const {
    return std::any_of(kAims.begin(), kAims.begin() + 2, [&](const TuneAim& other) {
      return &other != &aim_ && !gains(other, 0).empty() && gain(other, candidate).mean < -noise(other);
    });
  }
  // Candidates that are above the first one, best first.
  std::vector<std::size_t> ranking() const {
    std::vector<std::size_t> order;
    for (std::size_t c = 1; c < last().candidates.size(); ++c)
      if (gain(aim_, c).mean > 0 && !harms(c)) order.push_back(c);
    std::stable_sort(order.begin(), order.end(),
                     [&](std::size_t a, std::size_t b) { return gain(aim_, a).mean > gain(aim_, b).mean; });
    return order;
  }

  // What this scene has no data for is no candidate.
  bool has_data(const TuneAxis& axis) const {
    const CellValues& scored = out_.rounds.front().second[0][0];
    const auto idle = [&](const ConfigOverride& over) {
      const bool labels = over.key.starts_with("semantics.") || over.key.ends_with(".semantic");
      return (labels && !value_of(scored, "miou_present")) ||
             ((over.key + ".").starts_with("losses.depth.") && !value_of(scored, "absrel"));
    };
    const std::vector<ConfigOverride>& set = axis.values[0].set;
    return !std::all_of(set.begin(), set.end(), idle);
  }

  // Each process loads the scene first, which is no part of what later cells take.
  bool configured() {
    if (!round({"warm-up", whole(plan_.length / 16), plan_.at_a_time, {base_}}) ||
        !round({"as configured", whole(plan_.length / 8), plan_.seeds, {base_}}))
      return false;
    for (const CellValues& values : scores()[0])
      if (!value_of(values, aim_.metric))
        throw Error(ErrorKind::data, "tune.score.missing",
                    "the configuration itself could not be trained and scored by " + aim_.metric,
                    "run `semfield train` with it, and see log.txt in the folder's cells");
    return true;
  }

  bool alone() {
    std::vector<TuneChoice> candidates{base_};
    for (std::size_t axis = 0; axis < axes_.size(); ++axis)
      for (int value = 0; value < std::ssize(axes_[axis].values) && !axes_[axis].is_part && has_data(axes_[axis]);
           ++value)
        if (const TuneChoice one = with(base_, axis, value);
            write_config(with_choice(plan_, one)) != write_config(plan_.config))
          candidates.push_back(one);
    if (candidates.size() == 1) return true;
    // Half of the length if that lets some be tried: what learns slowly and ends higher loses in shorter trainings.
    const double half = whole(plan_.length / 2), until = search_until(kAloneUntil);
    TuneRound wanted = fit("alone", candidates, half, half, until, std::min(kFewTrusted, candidates.size()));
    if (wanted.candidates.empty()) wanted = fit("alone", candidates, whole(plan_.length / 8), half / 2, until);
    return round(wanted);
  }

  // The best value of each axis: two of them, three, ... And the better third of the values.
  bool together() {
    std::vector<TuneChoice> candidates{base_};
    TuneChoice sum = base_;
    std::size_t summed = 0;
    for (const std::size_t c : ranking()) {
      gained_.push_back(last().candidates[c]);
      const std::size_t axis = axis_of(gained_.back(), base_);
      if (sum[axis] >= 0 || summed++ >= kMostTogether) continue;
      sum[axis] = gained_.back()[axis];
      candidates.push_back(sum);
    }
    const std::size_t third = std::min(gained_.size(), last().candidates.size() / 3 + 1);
    for (std::size_t i = 1; i < third; ++i) candidates.push_back(gained_[i]);
    if (gained_.empty()) return true;
    if (!round(fit("together", candidates, last().length, whole(plan_.length / 2), search_until(kTogetherUntil))))
      return false;
    const std::vector<std::size_t> order = ranking();
    if (!order.empty()) out_.best = last().candidates[order[0]];
    if (order.size() > 1) second_ = last().candidates[order[1]];
    return true;
  }

  // With each other value that gained, in the place of what the best one has.
  bool around() {
    if (out_.best == base_) return true;
    std::vector<TuneChoice> candidates{out_.best};
    for (const TuneChoice& one : gained_) {
      const std::size_t axis = axis_of(one, base_);
      if (out_.best[axis] != one[axis]) candidates.push_back(with(out_.best, axis, one[axis]));
    }
    if (candidates.size() == 1) return true;
    if (!round(fit("around the best", candidates, last().length, whole(plan_.length / 2), search_until(1))))
      return false;
    const std::vector<std::size_t> order = ranking();
    if (skipped_ || order.empty() || gain(aim_, order[0]).mean <= noise(aim_)) return true;
    second_ = std::exchange(out_.best, last().candidates[order[0]]);
    return true;
  }

  bool full() {
    if (out_.best == base_) return true;
    std::vector<TuneChoice> candidates{base_, out_.best};
    if (second_ != base_) candidates.push_back(second_);
    TuneRound wanted{"full length", 0, 1, {}};
    for (const double part : kParts)
      for (const std::size_t some : {candidates.size(), std::size_t{2}})
        for (const int seeds : {plan_.seeds, 1}) {
          const std::vector<TuneChoice> last_few(candidates.begin(), candidates.begin() + static_cast<long>(some));
          const double length = whole(part * plan_.length);
          if (wanted.candidates.empty() && cost_s(last_few, seeds, length) <= left_s(kFullUntil))
            wanted = {wanted.name, length, seeds, last_few};
        }
    if (!round(wanted)) return false;
    if (skipped_ || is_brief()) {
      note("no time for half of the full length: nothing is changed; give more --time, or a shorter --length");
      out_.best = base_;
      return true;
    }
    const std::vector<std::size_t> order = ranking();
    const bool won = !order.empty() && gain(aim_, order[0]).mean > noise(aim_);
    out_.best = won ? last().candidates[order[0]] : base_;
    if (won) out_.gain = gain(aim_, order[0]);
    return true;
  }

  // The last round says little of the full length.
  bool is_brief() const { return last().length < kLeastTrusted * plan_.length; }

  double step_s(std::size_t candidate) const {
    double train_s = 0, steps = 0;
    for (const CellValues& values : scores()[candidate]) {
      train_s += value_of(values, "train_s").value_or(0);
      steps += value_of(values, "steps").value_or(0);
    }
    return train_s / std::max(1.0, steps);
  }

  bool leave_out() {
    std::vector<TuneChoice> candidates{out_.best};
    for (std::size_t axis = 0; axis < axes_.size(); ++axis)
      if ((axes_[axis].is_part && has_data(axes_[axis])) || out_.best[axis] >= 0)
        candidates.push_back(with(out_.best, axis, axes_[axis].is_part ? 0 : -1));
    if (candidates.size() == 1) return true;
    if (!round(fit("leave out", candidates, out_.best == base_ ? 0 : last().length, plan_.length, kOutUntil)))
      return false;
    if (skipped_) return true;
    TuneChoice reduced = out_.best;
    for (std::size_t c = 1; c < last().candidates.size(); ++c) {
      const TuneGain out = gain(aim_, c);
      if (out.mean == 0 && gain(kAims[0], c).mean == 0) continue;  // it was not built
      TunePart part{axis_of(last().candidates[c], out_.best), {-out.mean, out.seeds - out.sure, out.seeds}};
      part.name = axes_[part.axis].is_part ? axes_[part.axis].name
                                           : choice_name(axes_, with(base_, part.axis, out_.best[part.axis]));
      part.time_share = 1 - step_s(c) / std::max(1e-9, step_s(0));
      part.kept = is_brief() || out.mean < -slight() || harms(c);
      if (!part.kept) reduced[part.axis] = last().candidates[c][part.axis];
      out_.parts.push_back(std::move(part));
    }
    if (is_brief()) note("no time for long trainings without parts: all are kept");
    if (reduced == out_.best) return true;
    // Parts that are nothing each may be something together.
    const std::vector<TuneChoice> both{out_.best, reduced};
    const bool in_time = cost_s(both, last().seeds, last().length) <= left_s(1);
    if (!round({"reduced", last().length, last().seeds, in_time ? both : std::vector<TuneChoice>()})) return false;
    if (!skipped_ && gain(aim_, 1).mean >= -slight() && !harms(1)) {
      out_.best = reduced;
      return true;
    }
    for (TunePart& part : out_.parts) part.kept = true;
    if (!skipped_) note("more than noise in parts together that cost nothing each: none was left out");
    return true;
  }

  const std::vector<TuneAxis>& axes_;
  const TunePlan& plan_;
  TuneWork& work_;
  const TuneAim& aim_;
  bool skipped_ = false;  // the round was left out
  TuneChoice base_, second_;
  std::vector<TuneChoice> gained_;                    // alone, best first
  using Known = std::tuple<TuneChoice, double, int>;  // length and seed
  std::set<Known> known_;
  double unit_s_ = 1;  // seconds of a unit of length
  std::map<std::string, double> noise_;
  TuneOutcome out_;
};

}  // namespace

TuneOutcome race(const TunePlan& plan, TuneWork& work) { return Race(plan, work).run(); }

// What came out.

namespace {

MeanInterval mean_of(const std::vector<CellValues>& seeds, const std::string& metric) {
  std::vector<double> all;
  for (const CellValues& values : seeds)
    if (const auto value = value_of(values, metric)) all.push_back(*value);
  return mean_interval(all);
}

std::string mean_text(const std::vector<CellValues>& seeds, const std::string& metric, int digits) {
  const MeanInterval m = mean_of(seeds, metric);
  return m.n > 0 ? fmt::format("{:.{}f}", m.mean, digits) : "–";
}

using Table = std::vector<std::vector<std::string>>;

// A section of the page, as report.js shows an experiment.
Json section(const std::string& name, const std::string& title, const std::string& note, const Table& table) {
  return {{"name", name}, {"title", title}, {"note", note}, {"tables", Json::array({table})}, {"plot", nullptr}};
}

// Every candidate at every length that it trained for; the table has those that nothing quicker is better than.
Json front_section(const TunePlan& plan, const TuneAim& aim, const TuneOutcome& outcome, const std::string& note) {
  std::vector<std::tuple<double, double, std::string>> points;  // seconds, error, name
  const double sign = aim.name == "depth" ? 1 : -1;
  for (const auto& [round, scores] : outcome.rounds)
    for (std::size_t c = 0; c < round.candidates.size(); ++c)
      if (const MeanInterval m = mean_of(scores[c], aim.metric); m.n > 0)
        points.emplace_back(mean_of(scores[c], "train_s").mean, sign * m.mean,
                            choice_name(plan.axes, round.candidates[c]));
  std::sort(points.begin(), points.end());
  Json all = Json::array(), best = Json::array();
  Table table{{"candidate", "seconds of training", metric_label(aim.metric)}};
  double least = std::numeric_limits<double>::infinity();
  for (const auto& [train_s, error, name] : points) {
    all.push_back({{"x", train_s}, {"y", sign * error}});
    if (error >= least) continue;
    least = error;
    best.push_back(all.back());
    table.push_back({name, fmt::format("{:.2f}", train_s), fmt::format("{:.3f}", sign * error)});
  }
  Json out = section("front", "Error against run time", note, table);
  out["plot"] = {{"title", metric_label(aim.metric)}, {"x_label", "seconds of training"}, {"log_x", true}};
  out["plot"]["end_values"] = false;
  out["plot"]["series"] = {{{"name", "candidates"}, {"color", 0}, {"points", std::move(all)}, {"loose", true}},
                           {{"name", "best for the time"}, {"color", 1}, {"points", std::move(best)}}};
  return out;
}

}  // namespace

std::string gain_text(const TuneAim& aim, const TuneGain& gain) {
  if (gain.seeds == 0) return "not measured";
  if (!std::isfinite(gain.mean)) return "cannot do without";
  return fmt::format("{:+.{}f} {}, sure: {} of {} seeds", gain.mean, aim.digits, aim.unit, gain.sure, gain.seeds);
}

std::string tuned_config(const TunePlan& plan, const TuneOutcome& outcome, const std::string& include,
                         const std::string& command) {
  const TuneAim& aim = tune_aim(plan.aim);
  const std::vector<TuneAxis>& axes = plan.axes;
  const std::string name = std::filesystem::path(plan.path).stem().string() + "_tuned";
  std::string text =
      fmt::format("{}{}`: {}, noise {:.{}f}.\n", kTunedBy, command,
                  outcome.gain.seeds > 0 ? gain_text(aim, outcome.gain) : "no setting gains more than noise",
                  outcome.noise, aim.digits);
  for (const auto& [key, value] : {std::pair{"include", include}, {"name", name}})
    text += fmt::format("{}: {}\n", key, write_config_inline(ConfigNode::make_scalar(value, false, {})));
  std::string lines, of_losses;
  for (std::size_t axis = 0; axis < axes.size(); ++axis) {
    if (outcome.best[axis] < 0) continue;
    const TuneValue& value = axes[axis].values[static_cast<std::size_t>(outcome.best[axis])];
    std::string why = "no time to take it out";
    for (const TunePart& part : outcome.parts)
      if (part.axis == axis)
        why = axes[axis].is_part ? fmt::format("{}: it gains {}, takes {:.0f} % of a step", value.name,
                                               gain_text(aim, part.gain), 100 * part.time_share)
                                 : gain_text(aim, part.gain);
    for (const ConfigOverride& over : value.set) {
      if (names_loss(over.key)) {
        of_losses += (of_losses.empty() ? "" : "; ") + (axes[axis].is_part ? "" : value.name + ": ") + why;
      } else {
        lines += fmt::format("  {}: {}  # {}\n", over.key, write_config_inline(over.value), why);
      }
      if (!axes[axis].is_part) why = "with the line above";
    }
  }
  if (!of_losses.empty())
    lines += fmt::format("  losses: {}  # {}\n", write_config_inline(*with_choice(plan, outcome.best).find("losses")),
                         of_losses);
  return text + (lines.empty() ? "" : "overrides:\n" + lines);
}

std::pair<std::string, std::string> tune_tables(const TunePlan& plan, const TuneOutcome& outcome) {
  const std::string title = "Tuning of " + std::filesystem::path(plan.path).stem().string();
  const TuneAim& aim = tune_aim(plan.aim);
  const TuneAim& shown = aim.name == "time" ? kAims.front() : aim;
  std::string note = fmt::format(
      "Scored on held-out training views, one pixel of {0} x {0}; test frames were not looked at. Best: {1}. ",
      plan.score_stride, choice_name(plan.axes, outcome.best));
  note += outcome.gain.seeds == 0 ? "No setting gains more than noise."
                                  : fmt::format("{} over the configuration; noise is {:.{}f} {}.",
                                                gain_text(aim, outcome.gain), outcome.noise, aim.digits, aim.unit);
  for (const std::string& more : outcome.notes) note += " There was " + more + ".";
  Json parts = Json::array({front_section(plan, shown, outcome, note)});
  Table decided{{"part", "gain of having it", "time of a step", "decided"}};
  for (const TunePart& part : outcome.parts)
    decided.push_back({part.name, gain_text(aim, part.gain), fmt::format("{:+.0f} %", 100 * part.time_share),
                       part.kept ? "kept" : "left out"});
  parts.push_back(
      section("decided", "What decided", "Each difference and each optional part, taken out once.", decided));
  for (const auto& [round, scores] : outcome.rounds) {
    Table table{{"candidate", metric_label(shown.metric), "mIoU", "seconds of training", "steps"}};
    for (std::size_t c = 0; c < round.candidates.size(); ++c)
      table.push_back({choice_name(plan.axes, round.candidates[c]), mean_text(scores[c], shown.metric, 3),
                       mean_text(scores[c], "miou_present", 3), mean_text(scores[c], "train_s", 1),
                       mean_text(scores[c], "steps", 0)});
    parts.push_back(section(fmt::format("round-{}", parts.size() - 1), "Round: " + round.name,
                            fmt::format("{:g} {}, {} seeds.", round.length, plan.in_steps ? "steps" : "s", round.seeds),
                            table));
  }
  std::string markdown = "# " + title + "\n";
  for (const Json& part : parts) {
    markdown += "\n## " + part["title"].get<std::string>() + "\n\n" + part["note"].get<std::string>() + "\n";
    for (const Json& table : part["tables"]) markdown += "\n" + markdown_table(table.get<Table>());
  }
  const Json page{{"title", title}, {"experiments", std::move(parts)}};
  return {std::move(markdown), page.dump(-1, ' ', false, Json::error_handler_t::replace)};
}

}  // namespace semfield
