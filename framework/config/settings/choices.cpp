// What is decided where the configuration leaves it open: cameras, device, labels, pace and length of a run.
#include "config/settings/choices.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/checksum.h"
#include "core/files.h"
#include "core/text.h"
#include "execution/device_library.h"
#include "plugin/loader.h"

namespace semfield {

CameraReasons choose_cameras(CameraParams& cameras, const CameraEvidence& evidence) {
  CameraReasons why;
  if (cameras.poses == CameraTrust::automatic) {
    const bool fits = evidence.fits.value_or(false);
    cameras.poses = evidence.tracked && !fits ? CameraTrust::learned : CameraTrust::given;
    why.poses = !evidence.tracked ? "poses are not those of a phone's tracker"
                : fits            ? "poses are a phone's, and the photographs fit them"
                                  : "poses are a phone's, whose tracker drifts";
  }
  if (cameras.colors == CameraTrust::automatic) {
    const bool changes = evidence.exposure && *evidence.exposure > kExposureChanges;
    cameras.colors = changes ? CameraTrust::learned : CameraTrust::given;
    why.colors = evidence.exposure ? fmt::format(
                                         "overlapping frames differ in brightness by a factor of {:.3f}, and "
                                         "more than {:g} is a camera that changes its exposure",
                                         *evidence.exposure, kExposureChanges)
                                   : "too few overlapping frames could be compared in brightness";
  }
  if (!why.poses.empty() && cameras.poses == CameraTrust::learned)
    why.learned.push_back("train.cameras.poses: learned, because " + why.poses);
  if (!why.colors.empty() && cameras.colors == CameraTrust::learned)
    why.learned.push_back("train.cameras.colors: learned, because " + why.colors);
  return why;
}

namespace {

// docs/decisions.md, 0036; most rays of an object's photographs meet nothing
constexpr std::int64_t kRaysOnCpu = 1024, kRaysOnGpu = 8192, kOpenRaysOnGpu = 32768;

// "field 'ball'".
std::string owner_of(const PluginSlot& slot) {
  return std::string(kind_name(slot.entry->kind)) + " '" + slot.entry->name + "'";
}

// see(key, slot) for every plugin of the passes: "passes.main.semantic.field".
template <class See>
void each_slot(const RunConfig& config, const See& see) {
  const auto look = [&](const std::string& key, const auto& owner) {
    each_slot_of(owner, [&](const char* name, PluginKind, const PluginSlot& slot, bool) {
      if (slot.entry != nullptr) see(key + "." + name, slot);
    });
  };
  for (const PassConfig& pass : config.passes) {
    look(pass.key, pass);
    for (const SemanticBranchConfig& branch : pass.semantic) look(pass.key + "." + branch.key, branch);
  }
}

// "field 'ball'", "loss 'glow'": the first part of the run without kernels for `device`; empty: all have them.
std::string part_without_kernels(const RunConfig& config, const Registry& registry, Device device) {
  std::string lacking;
  const auto look = [&](const std::string& owner) {
    if (lacking.empty() && !registry.kernels().has(device, owner)) lacking = owner;
  };
  each_slot(config, [&](const std::string&, const PluginSlot& slot) { look(owner_of(slot)); });
  if (device == Device::cpu) return lacking;
  for (const HeadConfig& head : config.heads)
    for (const PluginSlot* slot : {&head.head, &head.position, &head.field}) look(owner_of(*slot));
  for (const LossEntry& entry : config.losses) look("loss '" + entry.type + "'");
  return lacking;
}

// "field 'ball'": the first field of the run without kernels of bf16 for `device`; empty: all have them.
std::string field_without_bf16(const RunConfig& config, const Registry& registry, Device device) {
  std::string lacking;
  each_slot(config, [&](const std::string&, const PluginSlot& slot) {
    if (lacking.empty() && slot.entry->kind == PluginKind::field &&
        !registry.kernels().has(device, owner_of(slot), Precision::bf16))
      lacking = owner_of(slot);
  });
  return lacking;
}

bool is_automatic(const RunConfig& config) { return config.runtime.device == "auto"; }

/// That of `auto` is the first cuda device.
DeviceId asked_device(const RunConfig& config) {
  const std::optional<DeviceId> asked = device_of(is_automatic(config) ? "cuda" : config.runtime.device);
  SEMFIELD_CHECK(asked.has_value(), "runtime.device was validated");
  return *asked;
}

// Of one pixel and the labelled one before it in its row or column, `distance` away.
void add_pair(std::int16_t label, std::int16_t other, std::int64_t distance, LabelStatistics& sums) {
  const bool beside = distance == 1;
  if (other == kVoid || distance > kReach) return;
  (beside ? sums.neighbours : sums.apart) += 1;
  if (label == other) (beside ? sums.equal : sums.apart_equal) += 1;
}

struct Seen {
  std::int64_t at = 0;  // column or row
  std::int16_t label = kVoid;
};

void add_frame(const TrainingLabels::Frame& labels, std::int32_t width_px, LabelStatistics& sums) {
  std::vector<Seen> above(static_cast<std::size_t>(width_px));
  Seen left;
  for (std::size_t pixel = 0; pixel < labels.size(); ++pixel) {
    const std::int16_t label = labels[pixel];
    const auto x = static_cast<std::int64_t>(pixel) % width_px, y = static_cast<std::int64_t>(pixel) / width_px;
    if (x == 0) left = {};
    if (label == kVoid) continue;
    Seen& over = above[static_cast<std::size_t>(x)];
    ++sums.labelled;
    add_pair(label, left.label, x - left.at, sums);
    add_pair(label, over.label, y - over.at, sums);
    left = {x, label};
    over = {y, label};
  }
}

// What is seen of their agreement, or that nothing is.
std::string agreement_text(const LabelStatistics& s) {
  if (s.side_by_side()) return fmt::format("{:.3g} % of neighbouring labels agree", 100 * s.agreement());
  if (s.share() >= kFewShare && s.near_one_another())
    return fmt::format("{:.3g} % of labels next to each other within {} pixels agree", 100 * s.agreement_apart(),
                       kReach);
  return "too few lie side by side to see whether many are wrong; if so, name the branch for noisy labels alone";
}

std::string reason_text(LabelKind kind, const LabelStatistics& s) {
  if (s.labelled == 0) return "labels are to come, and will be few";
  return fmt::format("labels are {} ({:.3g} % of the training pixels have one; {})", choice_name(kind), 100 * s.share(),
                     agreement_text(s));
}

constexpr double kShare = 1.0 / 40;                // of the time between two marks
constexpr std::size_t kMarks = 5;                  // a tenth of the time lies between the first and the last
constexpr double kEarliest = 0.1, kLatest = 0.25;  // of the time, when the number of steps is settled
constexpr double kStill = 0.05;                    // change of the rate between two shares that counts as none
constexpr double kMissed = 1.0 / 12;               // of the time, by which the end may miss it
constexpr double kLast = 0.1;                      // of the time at the end, in which nothing is settled anew

constexpr double kFurtherRate = 0.5;  // of a leg, where the rate has fallen below it: it learns, and forgets little

}  // namespace

void add_cuda_kernels(Registry& registry) {
  cuda_library().add_kernels(registry.kernels());
  add_cuda_kernels_of_modules(registry);
}

ChosenDevice chosen_device(const RunConfig& config, Registry& registry, Diagnostics& diagnostics) {
  const DeviceId asked = asked_device(config);
  if (asked.kind == Device::cpu) return {asked, "runtime.device is cpu"};
  std::string why_not;
  if (cuda_available(&why_not, asked.ordinal)) {
    add_cuda_kernels(registry);
    return device_for_parts(config, registry, diagnostics);
  }
  if (is_automatic(config)) return {DeviceId{}, why_not};
  throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
              "runtime.device: " + config.runtime.device + ": " + why_not, "set runtime.device: cpu, or auto");
}

ChosenDevice device_for_parts(const RunConfig& config, const Registry& registry, Diagnostics& diagnostics) {
  const std::string part = part_without_kernels(config, registry, Device::cuda);
  if (part.empty()) return {asked_device(config), ""};
  const std::string why_not = part + " has no cuda kernels";
  if (!is_automatic(config)) {
    throw Error(ErrorKind::unavailable, "device.gpu.unavailable",
                "runtime.device: " + config.runtime.device + ": " + why_not,
                "set runtime.device: cpu, or auto, which stays on the CPU then");
  }
  diagnostics.warning("device.cpu.slow", "runtime.device",
                      why_not + ", so the run stays on the CPU, which is tens to hundreds of times slower than a GPU",
                      "use parts that have kernels for it: `semfield plugins list --devices` lists them");
  return {DeviceId{}, why_not};
}

Precision precision_of(const RunConfig& config, const Registry& registry, DeviceId device) {
  if (config.runtime.precision != Precision::automatic) return config.runtime.precision;
  const bool faster = device.kind != Device::cpu || bf16_is_faster();
  return faster && field_without_bf16(config, registry, device.kind).empty() ? Precision::bf16 : Precision::fp32;
}

std::vector<std::string> choose_for_device(RunConfig& config, Device device) {
  std::vector<std::string> lines;
  if (config.train.rays == 0) {
    config.train.rays = device == Device::cpu                   ? kRaysOnCpu
                        : config.rendering.far == FarMode::open ? kOpenRaysOnGpu
                                                                : kRaysOnGpu;
    lines.push_back("train.rays: rays was set to " + std::to_string(config.train.rays) + ", which suits a " +
                    (device == Device::cpu ? "CPU" : "GPU"));
  }
  each_slot(config, [&](const std::string& key, const PluginSlot& slot) {
    std::vector<std::string> chosen;
    slot.params->choose_for(device, chosen);
    for (const std::string& sentence : chosen) lines.push_back(key + ": " + sentence);
  });
  return lines;
}

// Steps on an H200 in fp32 and bf16 (docs/evidence/gpu.md): 22.7 and 2.24 ms with the paper's networks, 3.0 and 0.99 ms
// with a hash grid; 16.5 and 1.1 ms with the networks of configs/presets/object.yaml and 8,192 rays.
void say_slow_paths(const RunConfig& config, const Registry& registry, DeviceId device, bool bf16_instructions,
                    Diagnostics& diagnostics) {
  const bool bf16 = config.runtime.precision == Precision::bf16;
  if (device.kind == Device::cpu) {
    if (bf16 && !bf16_instructions) {
      diagnostics.warning("device.bf16.emulated", "runtime.precision",
                          "this CPU has no bf16 instructions: they are emulated, which is slower than fp32",
                          "set runtime.precision: auto");
    }
    return;
  }
  if (bf16) return;
  const std::string lacking = field_without_bf16(config, registry, device.kind);
  const std::string cost = "fp32 runs layer by layer on a GPU, 3 to 15 times slower than bf16";
  if (lacking.empty()) {
    diagnostics.warning("device.bf16.slow", "runtime.precision", cost, "set runtime.precision: auto");
  } else {
    diagnostics.warning("device.bf16.slow", "runtime.precision", cost + "; " + lacking + " has no kernels of bf16",
                        "use a field that has: `semfield plugins list --devices` lists them");
  }
}

LabelStatistics label_statistics(const LoadedScene& scene, const TrainingLabels& labels) {
  std::vector<LabelStatistics> of_frame(scene.frames.size());
  parallel_for(std::ssize(scene.frames), [&](std::int64_t i) {
    const auto f = static_cast<std::size_t>(i);
    if (scene.info.frames[f].split != Split::train) return;
    of_frame[f].pixels = std::int64_t{scene.frames[f].width_px} * scene.frames[f].height_px;
    if (!labels.frames[f].empty()) add_frame(labels.frames[f], scene.frames[f].width_px, of_frame[f]);
  });
  LabelStatistics sums;
  for (const LabelStatistics& frame : of_frame) {
    sums.pixels += frame.pixels;
    sums.labelled += frame.labelled;
    sums.neighbours += frame.neighbours;
    sums.equal += frame.equal;
    sums.apart += frame.apart;
    sums.apart_equal += frame.apart_equal;
  }
  return sums;
}

LabelKind kind_of(const LabelStatistics& s) {
  const bool few = s.share() < kFewShare;
  if (s.side_by_side()) {
    if (s.agreement() < kAgreement) return LabelKind::noisy;
  } else if (!few && s.near_one_another() && s.agreement_apart() < kAgreementApart) {
    return LabelKind::noisy;
  }
  return few ? LabelKind::few : s.share() < kDenseShare ? LabelKind::many : LabelKind::dense;
}

std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics) {
  std::vector<std::string> lines;
  const LabelKind kind = kind_of(statistics);
  for (PassConfig& pass : config.passes) {
    if (pass.semantic.size() < 2) continue;
    const auto fits = std::find_if(pass.semantic.begin(), pass.semantic.end(), [kind](const SemanticBranchConfig& b) {
      return b.labels == kind || b.labels == LabelKind::any ||
             (kind == LabelKind::dense && b.labels == LabelKind::many);
    });
    SEMFIELD_CHECK(fits != pass.semantic.end(), "some branch is for every kind of labels");
    std::vector<SemanticBranchConfig> chosen;
    chosen.push_back(std::move(*fits));
    pass.semantic = std::move(chosen);
    lines.push_back(fmt::format("{}.{}: {} and {} were chosen, because {}", pass.key, pass.branch()->key,
                                pass.branch()->position.entry->name, pass.branch()->field.entry->name,
                                reason_text(kind, statistics)));
  }
  return lines;
}

std::string choose_ray_source(TrainParams& train, const LabelCount& labels) {
  if (train.ray_source != RaySourceKind::automatic) return {};
  const bool balanced = labels.labelled_px > 0 || labels.may_come;
  train.ray_source = balanced ? RaySourceKind::label_balanced : RaySourceKind::all_images;
  if (!balanced) return "train.ray_source: all_images was chosen, because no training pixel has a label";
  if (labels.labelled_px == 0)
    return "train.ray_source: label_balanced was chosen, because labels may come; until then rays come from all pixels";
  return fmt::format(
      "train.ray_source: label_balanced was chosen, because {:.3g} % of the training pixels have a label; they get "
      "{:g} % "
      "of the rays",
      100.0 * static_cast<double>(labels.labelled_px) / static_cast<double>(labels.train_px),
      100 * train.labelled_share);
}

void warn_of_rare_labels(const TrainParams& train, const LabelCount& labels, Diagnostics& diagnostics) {
  const bool evenly = train.ray_source == RaySourceKind::all_images || train.ray_source == RaySourceKind::one_image;
  const double share =
      static_cast<double>(labels.labelled_px) / static_cast<double>(std::max<std::int64_t>(1, labels.train_px));
  if (!evenly || labels.labelled_px == 0 || share >= kRareShare) return;
  diagnostics.warning(
      "train.ray_source.rare", "train.ray_source",
      fmt::format(
          "{} draws pixels evenly, and {:.3g} % of them have a label: about {:.3g} of the {} rays of a step see "
          "one, so classes are hardly learned",
          choice_name(train.ray_source), 100 * share, share * static_cast<double>(train.rays), train.rays),
      "set train.ray_source: auto");
}

Pace::Pace(double begin_s, double until_s)
    : begin_s_(begin_s), until_s_(until_s), share_s_((until_s - begin_s) * kShare), settled_{begin_s, 0} {}

double Pace::steps_per_s() const {
  if (marks_.size() < 2) return 0;
  const Mark &first = marks_.front(), &last = marks_.back();
  return static_cast<double>(last.step - first.step) / std::max(last.s - first.s, 1e-9);
}

bool Pace::still() const {
  if (marks_.size() < kMarks) return false;
  const auto rate = [&](std::size_t from, std::size_t to) {
    return static_cast<double>(marks_[to].step - marks_[from].step) / std::max(marks_[to].s - marks_[from].s, 1e-9);
  };
  const double before = rate(0, kMarks / 2), now = rate(kMarks / 2, kMarks - 1);
  return std::abs(now - before) <= kStill * before;
}

std::int64_t Pace::end_at_this_rate() const {
  const double left = std::max(0.0, until_s_ - marks_.back().s) * steps_per_s();
  return marks_.back().step + std::llround(left);
}

// Seconds; above 0: the end comes too late.
double Pace::misses_by(double rate, std::int64_t end) const {
  return marks_.back().s + static_cast<double>(end - marks_.back().step) / std::max(rate, 1e-9) - until_s_;
}

std::optional<std::int64_t> Pace::made(std::int64_t step, double train_s, std::int64_t end) {
  const double time_s = until_s_ - begin_s_;
  if (end == 0 && train_s >= until_s_) return step;
  const bool ended = end > 0 && step >= end;
  if (!marks_.empty() && train_s - marks_.back().s < share_s_ && !ended) return std::nullopt;
  marks_.push_back({train_s, step});
  if (marks_.size() > kMarks) marks_.pop_front();
  const double used_s = train_s - begin_s_;
  if (end == 0) {
    const bool due = used_s >= kEarliest * time_s && (still() || used_s >= kLatest * time_s);
    if (!due || marks_.size() < 2) return std::nullopt;
    settled_ = marks_.back();
    return end_at_this_rate();
  }
  const bool measured = marks_.size() == kMarks && marks_.front().s >= settled_.s;
  if ((!measured && !ended) || marks_.size() < 2 || until_s_ - train_s < kLast * time_s) return std::nullopt;
  // Of the last tenth, and of all since it was settled: what passes within a moment moves the first alone.
  const double now = misses_by(steps_per_s(), end);
  const double since = misses_by(static_cast<double>(step - settled_.step) / (train_s - settled_.s), end);
  if (!ended &&  // before there were steps to measure, as after a stall in which the number was settled
      (std::abs(now) <= kMissed * time_s || now * since <= 0 || std::abs(since) <= 0.5 * kMissed * time_s))
    return std::nullopt;
  settled_ = marks_.back();
  return end_at_this_rate();
}

std::int64_t last_step(const RunConfig& config) {
  const std::vector<ScheduleLeg>& legs = config.schedule.legs;
  return legs.empty() ? config.train.steps : legs.back().end;
}

double end_s(const RunConfig& config) {
  const std::vector<ScheduleLeg>& legs = config.schedule.legs;
  return legs.empty() ? config.train.time_s : legs.back().until_s;
}

std::string length_text(const RunConfig& config) {
  const std::int64_t end = last_step(config);
  return end > 0 ? fmt::format("{} steps", end) : fmt::format("{:.0f} s of training", end_s(config));
}

void ask(RunConfig& config, const AskedLength& asked) {
  config.train.steps = asked.steps;
  config.train.time_s = asked.seconds;
  config.schedule.hold_steps = 0;
  config.schedule.decay_steps = asked.steps;
  config.schedule.legs.clear();
}

void ask_more(RunConfig& config, const AskedLength& asked, std::int64_t step, double train_s) {
  if (step == 0) return ask(config, asked);
  ScheduleParams& schedule = config.schedule;
  std::erase_if(schedule.legs, [&](const ScheduleLeg& leg) { return leg.start >= step; });
  const double until_s = asked.seconds > 0 ? train_s + asked.seconds : 0;
  if (last_step(config) == 0) {  // it still holds its rate, and goes on doing so
    if (schedule.legs.empty()) {
      config.train.time_s = until_s;
    } else {
      schedule.legs.back().until_s = until_s;
    }
    if (asked.steps > 0) settle(config, step, step + asked.steps);
    return;
  }
  ScheduleLeg leg;
  leg.start = leg.hold_until = step;
  leg.rate = schedule_factor(schedule, step);
  if (schedule.kind != ScheduleKind::constant) leg.rate = std::max(leg.rate, kFurtherRate);
  if (asked.steps > 0) leg.end = step + asked.steps;
  leg.until_s = until_s;
  schedule.legs.push_back(leg);
}

std::string resolve_length(RunConfig& config, Device device) {
  ScheduleParams& schedule = config.schedule;
  std::string text;
  if (last_step(config) == 0 && end_s(config) <= 0) {
    const bool cpu = device == Device::cpu;
    config.train.steps = cpu ? kStepsOnCpu : kStepsOnGpu;
    text = fmt::format("{} steps, the length for a {}; train.time_s or train.steps asks for another",
                       config.train.steps, cpu ? "CPU" : "GPU");
  }
  if (config.train.steps > 0 && schedule.decay_steps == 0) schedule.decay_steps = config.train.steps;
  if (config.train.steps == 0) schedule.hold_steps = schedule.decay_steps = 0;
  return text;
}

void settle(RunConfig& config, std::int64_t step, std::int64_t end) {
  ScheduleParams& schedule = config.schedule;
  if (last_step(config) == 0 && schedule.legs.empty()) {
    config.train.steps = schedule.decay_steps = end;
    schedule.hold_steps = step;
  } else if (last_step(config) == 0) {
    schedule.legs.back().hold_until = step;
    schedule.legs.back().end = end;
  } else {
    schedule.legs.push_back({step, schedule_factor(schedule, step), step, end, end_s(config)});
  }
}

void check_length(const RunConfig& config, Diagnostics& diagnostics) {
  const std::int64_t end = last_step(config);
  if (end > 0 && config.schedule.warmup_steps >= end) {
    diagnostics.error("config.schedule.warmup", "train.schedule.warmup_steps",
                      fmt::format("a warm-up of {} steps does not end in a run of {}: the learning rate never reaches "
                                  "its value",
                                  config.schedule.warmup_steps, end),
                      "warm up for fewer steps, or train longer");
  }
  for (const LossEntry& entry : config.losses) {
    const double share = entry.loss->rule().from_step;
    const bool never = end > 0 ? step_of_share(share, config.train.steps, config.schedule) >= end : share >= 1;
    if (!never) continue;
    diagnostics.error("config.loss.never", entry.where,
                      fmt::format("losses: the term '{}' never works: its from_step {:.6g} is the end of the run{}",
                                  entry.type, share, end > 0 ? fmt::format(" of {} steps", end) : ""),
                      "let it begin earlier, or take it out of the list");
  }
}

namespace {

// Sections ("report.") and single keys; see is_part_of_identity. Where data lie is no part of it, what they are is: a
// checkpoint keeps that (checkpoint.h).
constexpr std::string_view kFree =
    "name base_dir plugins report. fuse. propagate. limits. train.steps train.time_s train.schedule.decay_steps "
    "train.schedule.hold_steps train.schedule.legs. runtime.threads runtime.memory_gb runtime.device scene.root "
    "scene.file scene.classes scene.labels.clicks scene.labels.from.folder scene.labels.from.file "
    "scene.labels.from.classes";

// The one cause that can be named better than by a place in a file that is not there: a path of the machine's.
void require_utf8(const std::string& text) {
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t length = utf8_length(text, i);
    if (length == 0) {
      const std::size_t begin = text.rfind('\n', i) + 1, end = text.find('\n', i);
      throw Error(
          ErrorKind::config, "config.text.encoding",
          "run.yaml cannot hold '" + text.substr(begin, end - begin) + "': it is not UTF-8; nothing was written",
          "give the folder or file another name");
    }
    i += length;
  }
}

// Without them a step that fails would fail again after each resume.
constexpr std::string_view kRescue = "train.adam. train.schedule. runtime.seed runtime.precision";

bool listed(std::string_view list, std::string_view key_path) {
  const std::vector<std::string_view> entries = words_of(list);
  return std::any_of(entries.begin(), entries.end(), [&](std::string_view entry) {
    return entry.ends_with('.') ? key_path.starts_with(entry) : key_path == entry;
  });
}

}  // namespace

bool is_part_of_identity(std::string_view key_path) { return !listed(kFree, key_path); }

bool may_change_on_resume(std::string_view key_path) {
  return !is_part_of_identity(key_path) || listed(kRescue, key_path);
}

std::string identity_hash(const RunConfig& config) {
  std::string text;
  for (const ConfigSetting& setting : config_settings(resolved_config(config))) {
    if (is_part_of_identity(setting.key)) text += setting.key + ": " + setting.value + "\n";
  }
  return hex64(fnv1a64(text));
}

void require_scene_places(const RunConfig& config, const std::string& run_dir) {
  for (const ConfigSetting& setting : config_settings(resolved_config(config))) {
    if (!setting.key.starts_with("scene.") || is_part_of_identity(setting.key)) continue;
    if (setting.key == "scene.labels.clicks") continue;  // which Run opens
    const std::string place = parse_config_value(setting.value, setting.key).text();
    if (place.empty() || is_there(fs::path(config.base_dir) / place)) continue;
    throw Error(ErrorKind::no_input, "run.scene.moved",
                "'" + place + "' is not there, where " + setting.key + " of the run '" + run_dir + "' points",
                "if the data moved, add --set " + setting.key + "=NEW_PLACE");
  }
}

std::string run_config_text(const RunConfig& config, Registry& registry) {
  const std::string text = write_config(resolved_config(config));
  require_utf8(text);
  try {
    // Modules are loaded already.
    const ConfigNode tree = parse_config_text(text, "the run's run.yaml").without("plugins");
    Diagnostics diagnostics;
    RunConfig again = read_run_config(tree, registry, diagnostics);
    diagnostics.throw_if_errors(ErrorKind::config, "");
    again.plugins = config.plugins;
    SEMFIELD_CHECK(write_config(resolved_config(again)) == text, "run.yaml reads back as it was written");
  } catch (Error& error) {
    throw error.while_doing("while reading back the run.yaml that this run would write; nothing was written");
  }
  return text;
}

}  // namespace semfield
