#include "session/memory_plan.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <functional>

#include "compute/parallel.h"
#include "core/error.h"
#include "core/text.h"
#include "session/self_training.h"
#include "system/process.h"

namespace semfield {

namespace {

// A thread's stack and heap as far as they are touched, beside its arena: 4 to 9 MB for 16 threads were measured.
constexpr std::size_t kThreadBytes = std::size_t{384} << 10;

constexpr std::size_t kMapBytes = 34;      // of a rendered pixel: colour, depth, opacity, class, three probabilities
constexpr std::size_t kScoreBytes = 24;    // beside it while a frame is scored: truth as colour, class and depth
constexpr std::size_t kPictureBytes = 24;  // six pictures a frame of the report: pixels, file, text of the page
constexpr std::size_t kRayBytes = 8 * sizeof(double) + 3 * sizeof(float) + sizeof(std::int16_t);
constexpr std::size_t kRenderRays = 8192;  // rays a call when frames are rendered

std::size_t size(std::int64_t n) { return static_cast<std::size_t>(std::max<std::int64_t>(n, 0)); }

// A whole number of the configuration that can be lowered.
struct Lever {
  std::string path;
  std::int64_t now = 0, lowest = 1;
  std::function<void(std::int64_t)> set;
};

// Lists the integers of a parameter struct, or sets the one at `index`.
class Integers final : public ParamVisitor {
 public:
  struct Found {
    std::string name;
    std::int64_t value, lowest;
  };
  Integers() = default;
  Integers(std::size_t index, std::int64_t value) : index_(index), value_(value), sets_(true) {}
  const std::vector<Found>& found() const { return found_; }

  void boolean(const ParamInfo&, bool&) override {}
  void integer(const ParamInfo& info, std::int64_t& value) override {
    if (sets_ && found_.size() == index_) value = value_;
    const double lowest = std::max(1.0, std::ceil(info.range.min));
    found_.push_back({std::string(info.name), value, static_cast<std::int64_t>(std::min(lowest, 1e15))});
  }
  void real(const ParamInfo&, double&) override {}
  void text(const ParamInfo&, std::string&) override {}
  void choice(const ParamInfo&, int&, std::span<const std::string_view>) override {}
  void integers(const ParamInfo&, std::vector<std::int64_t>&) override {}
  void reals(const ParamInfo&, std::vector<double>&) override {}
  void texts(const ParamInfo&, std::vector<std::string>&) override {}

 private:
  std::size_t index_ = 0;
  std::int64_t value_ = 0;
  bool sets_ = false;
  std::vector<Found> found_;
};

void add_slot(std::vector<Lever>& levers, const std::string& path, const PluginSlot& slot) {
  if (slot.entry == nullptr) return;
  Integers all;
  slot.params->describe(all);
  for (std::size_t i = 0; i < all.found().size(); ++i) {
    const Integers::Found& found = all.found()[i];
    levers.push_back({path + "." + found.name, found.value, found.lowest, [&slot, i](std::int64_t value) {
                        Integers setter(i, value);
                        slot.params->describe(setter);
                      }});
  }
}

std::vector<Lever> levers_of(RunConfig& config) {
  std::vector<Lever> levers;
  levers.push_back({"runtime.lanes", config.runtime.lanes, 1,
                    [&config](std::int64_t v) { config.runtime.lanes = static_cast<int>(v); }});
  levers.push_back({"train.rays", config.train.rays, 16, [&config](std::int64_t v) { config.train.rays = v; }});
  levers.push_back({"semantics.hidden_width", config.semantics.hidden_width, 16,
                    [&config](std::int64_t v) { config.semantics.hidden_width = static_cast<int>(v); }});
  for (const PassConfig& pass : config.passes) {
    add_slot(levers, pass.key + ".sampler", pass.sampler);
    add_slot(levers, pass.key + ".position", pass.position);
    add_slot(levers, pass.key + ".field", pass.field);
    if (const SemanticBranchConfig* branch = pass.branch())
      add_slot(levers, pass.key + "." + branch->key + ".field", branch->field);
  }
  return levers;
}

// The largest value below `now` at which `fits`, which holds for small values if for any; 0: none.
std::int64_t largest_that_fits(std::int64_t lowest, std::int64_t now, const std::function<bool(std::int64_t)>& fits) {
  if (now <= lowest || !fits(lowest)) return 0;
  std::int64_t low = lowest, high = now;
  while (high - low > 1) {
    const std::int64_t middle = low + (high - low) / 2;
    (fits(middle) ? low : high) = middle;
  }
  return low;
}

// A scene at 1/d of its width and height.
MemoryFacts downscaled(MemoryFacts facts, std::int64_t d) {
  const std::size_t area = size(d) * size(d), saved = facts.frames - facts.frames / area;
  facts.frames -= saved;
  facts.loaded -= std::min(saved, facts.loaded);
  facts.loading -= std::min(saved, facts.loading);
  facts.pixels /= area;
  facts.train_pixels /= static_cast<std::int64_t>(area);
  return facts;
}

}  // namespace

std::size_t MemoryPlan::peak() const {
  std::size_t sum = 0, turn = 0;
  for (const MemoryItem& item : held) sum += item.bytes;
  for (const MemoryItem& item : turns) turn = std::max(turn, item.bytes);
  return std::max(loading, sum + turn);
}

const MemoryItem& MemoryPlan::largest() const {
  return *std::max_element(held.begin(), held.end(),
                           [](const MemoryItem& a, const MemoryItem& b) { return a.bytes < b.bytes; });
}

MemoryPlan plan_memory(const RunConfig& config, const MemoryFacts& facts, const NetworkPlan& network) {
  MemoryPlan plan;
  const std::size_t rays = size(config.train.rays);
  const std::size_t known = facts.program + facts.frames;
  plan.held = {
      {"program and libraries", facts.program + (facts.loaded > known ? facts.loaded - known : 0) +
                                    kThreadBytes * static_cast<std::size_t>(thread_count() - 1)},
      {"scene: pixels and labels", facts.frames},
      {"model: values", network.tensors.values},
      {"model: gradients", network.tensors.gradients},
      {"model: gradient lanes", network.tensors.lanes},
      {"model: moments of Adam", network.tensors.moments},
      {"rays of a step and their encoding", rays * kRayBytes + network.step_rows},
      {"activations", network.activations + network.density},
      {"logits", network.logits},
  };
  // Rendered maps of the frames that the report shows are kept from the last evaluation on.
  const std::size_t shown = size(config.report.strips) + size(config.report.worst_frames);
  const std::size_t maps = shown * facts.pixels * kMapBytes;
  plan.turns = {
      {"evaluation", maps + facts.pixels * (kMapBytes + kScoreBytes) + kRenderRays * kRayBytes},
      {"checkpoint: written, then read back", network.tensors.stored},
      {"report", maps + shown * facts.pixels * kPictureBytes},
  };
  if (!config.self_training.at.empty()) {
    // The labels of one round, and those of the next while it is made: in a frame as read, as maps, and as a file that
    // is read back.
    const std::size_t labels = self_label_bytes(facts.train_pixels, facts.classes);
    plan.held.push_back({"labels of self-training", labels});
    plan.turns.push_back({"round of self-training",
                          4 * labels + facts.pixels * (kMapBytes + sizeof(std::int16_t)) + kRenderRays * kRayBytes});
  }
  plan.loading = facts.loading;
  return plan;
}

std::size_t allowed_memory(double memory_gb) {
  const std::size_t available = available_memory();
  const std::size_t system = available == kNoMemoryLimit ? kNoMemoryLimit : resident_bytes() + available;
  if (memory_gb <= 0) return system;
  return std::min(system, static_cast<std::size_t>(memory_gb * (1 << 30)));
}

std::vector<std::string> settings_that_fit(RunConfig& config, const Registry& registry, const BuildPlan& plan,
                                           const SceneExtent& extent, const MemoryFacts& facts, std::size_t allowed) {
  struct Setting {
    double mildness;
    std::string text;
  };
  std::vector<Setting> found;
  const std::size_t aim = allowed - allowed / 50;  // another start of the program holds a little more or less
  const auto peak = [&](const MemoryFacts& with) {
    return plan_memory(config, with, make_parts<float>(config, registry, plan, extent).plan(config, true)).peak();
  };
  for (const Lever& lever : levers_of(config)) {
    const std::int64_t value = largest_that_fits(lever.lowest, lever.now, [&](std::int64_t v) {
      lever.set(v);
      bool fits = false;
      try {
        fits = peak(facts) <= aim;
      } catch (const Error&) {  // a value that does not go with the others
      }
      lever.set(lever.now);
      return fits;
    });
    if (value > 0)
      found.push_back({static_cast<double>(value) / static_cast<double>(lever.now),
                       fmt::format("{}={} (now {})", lever.path, value, lever.now)});
  }
  for (std::int64_t d = 2; d <= 16; d *= 2) {
    if (config.load.downscale != 1 || config.load.width_px > 0 || config.load.height_px > 0) break;
    if (peak(downscaled(facts, d)) > aim) continue;
    found.push_back({1.0 / static_cast<double>(d), fmt::format("scene.load.downscale={} (now 1)", d)});
    break;
  }
  std::stable_sort(found.begin(), found.end(),
                   [](const Setting& a, const Setting& b) { return a.mildness > b.mildness; });
  std::vector<std::string> out;
  for (const Setting& setting : found) {
    if (out.size() < 3) out.push_back(setting.text);
  }
  return out;
}

void require_memory(RunConfig& config, const Registry& registry, const BuildPlan& plan, const SceneExtent& extent,
                    const MemoryFacts& facts, const MemoryPlan& memory) {
  const std::size_t allowed = allowed_memory(config.runtime.memory_gb);
  if (memory.peak() <= allowed) return;
  const MemoryItem& largest = memory.largest();
  const std::vector<std::string> settings = settings_that_fit(config, registry, plan, extent, facts, allowed);
  throw Error(ErrorKind::unavailable, "memory.training.size",
              fmt::format("training would take {} of memory at its peak, {} are available{}; the largest part is "
                          "'{}' with {}",
                          memory_text(memory.peak()), memory_text(allowed),
                          config.runtime.memory_gb > 0 ? " (runtime.memory_gb, or what the system leaves)" : "",
                          largest.name, memory_text(largest.bytes)),
              settings.empty() ? "no single setting makes it fit: lower several, or use a machine with more memory"
                               : "each of these alone fits: --set " + join(settings, ", or --set "));
}

void require_frame_memory(const RunConfig& config, std::size_t frame_bytes, std::size_t frames, int width_px) {
  const std::size_t allowed = allowed_memory(config.runtime.memory_gb), held = resident_bytes();
  const std::size_t room = allowed > held ? allowed - held : 0;
  if (frame_bytes <= room || frames == 0) return;
  const double share = static_cast<double>(room) / static_cast<double>(frame_bytes);
  const auto fitting = static_cast<std::size_t>(share * static_cast<double>(frames));
  const double shrink = std::ceil(10 * std::sqrt(1 / std::max(share, 1e-6))) / 10;
  const int width = static_cast<int>(width_px / shrink);
  const std::string settings = fmt::format(
      "each of these alone fits: scene.load.downscale={:.1f}, or scene.load.width_px={} (now {}), or a scene of {} "
      "frames",
      config.load.downscale * shrink, width, width_px, fitting);
  const std::string none = fmt::format(
      "the program alone holds {}: raise --memory or runtime.memory_gb where they set the limit, or use a machine with "
      "more memory",
      memory_text(held));
  throw Error(ErrorKind::unavailable, "memory.frames.size",
              fmt::format("the pixels of {} frames would take {} of memory, {} are available", frames,
                          memory_text(frame_bytes), memory_text(room)),
              width > 0 && fitting > 0 ? settings : none);
}

std::string memory_table(const MemoryPlan& plan, std::size_t allowed) {
  const auto row = [](const char* head, const std::string& name, std::size_t bytes) {
    return fmt::format("{:<10}{:<37}{:>9}\n", head, name, memory_text(bytes));
  };
  std::string out = fmt::format("memory    {} at the peak, of {}\n", memory_text(plan.peak()),
                                allowed == kNoMemoryLimit ? "an unknown size" : memory_text(allowed));
  for (const MemoryItem& item : plan.held) out += row("", item.name, item.bytes);
  for (const MemoryItem& item : plan.turns) out += row("  in turn", item.name, item.bytes);
  return out + row("  before", "while the scene was read", plan.loading);
}

}  // namespace semfield
