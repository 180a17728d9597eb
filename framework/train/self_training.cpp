#include "train/self_training.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "compute/parallel.h"
#include "core/checksum.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/safetensors.h"

namespace semfield {

namespace {

constexpr const char* kSelfLabelsFormat = "semfield-self-labels-1";
constexpr const char* kRemedy =
    "resume from a checkpoint of an earlier step: move the later ones out of the folder checkpoints; the round is then "
    "made again";

// Bytes of a class index on disk; the largest value of so many stands for none.
std::size_t index_bytes(int classes) { return classes < 255 ? 1 : 2; }

std::string tensor_name(std::size_t index, const FrameInfo& frame) {
  return fmt::format("{:06d}/{}", index, frame.name);
}

std::vector<std::uint8_t> encode(const LabelMap& labels, std::size_t pixels, std::size_t bytes) {
  std::vector<std::uint8_t> out(pixels * bytes, 255);
  for (std::size_t p = 0; p < labels.size(); ++p) {
    if (labels[p] == kVoid) continue;
    out[p * bytes] = static_cast<std::uint8_t>(labels[p] & 255);
    if (bytes == 2) out[2 * p + 1] = static_cast<std::uint8_t>(labels[p] >> 8);
  }
  return out;
}

// Throws where a value is neither a class nor none.
LabelMap decode(std::span<const std::byte> bytes, std::size_t width, int classes, const std::string& place) {
  std::vector<std::int16_t> labels(bytes.size() / width, kVoid);
  const int none = width == 1 ? 255 : 65535;
  for (std::size_t p = 0; p < labels.size(); ++p) {
    int value = std::to_integer<int>(bytes[p * width]);
    if (width == 2) value |= std::to_integer<int>(bytes[2 * p + 1]) << 8;
    if (value == none) continue;
    if (value >= classes)
      throw Error(ErrorKind::data, "checkpoint.labels.damaged",
                  fmt::format("{}: label {} is not a class; there are {}", place, value, classes), kRemedy);
    labels[p] = static_cast<std::int16_t>(value);
  }
  return LabelMap(std::move(labels));
}

std::size_t pixels_of(const FrameInfo& frame) {
  return static_cast<std::size_t>(frame.camera.width_px) * static_cast<std::size_t>(frame.camera.height_px);
}

// round_00001500.safetensors; none for other names.
std::optional<std::int64_t> step_of_file(const std::string& name) {
  constexpr std::string_view kHead = "round_", kTail = ".safetensors";
  if (!name.starts_with(kHead) || !name.ends_with(kTail)) return std::nullopt;
  return to_number<std::int64_t>(
      std::string_view(name).substr(kHead.size(), name.size() - kHead.size() - kTail.size()));
}

// What a checkpoint says of the labels of a round, by the checksum of their tensors.
std::string name_of_round(std::int64_t step, std::uint32_t crc) { return fmt::format("{} {:08x}", step, crc); }

}  // namespace

std::vector<std::int64_t> round_steps(const RunConfig& config) {
  std::vector<std::int64_t> out;
  if (config.train.steps <= 0) return out;
  for (const double share : config.self_training.at) {
    const std::int64_t nearest = std::llround(share * static_cast<double>(config.train.steps));
    const std::int64_t step = std::max({std::int64_t{1}, config.schedule.hold_steps, nearest});
    if (out.empty() || step > out.back()) out.push_back(step);
  }
  return out;
}

SelfTraining::SelfTraining(const Session& session, RaySource& rays, std::string folder)
    : session_(session), rays_(rays), folder_(std::move(folder)), frames_(session.drawn_frames()) {}

std::string SelfTraining::path_of(std::int64_t step) const {
  return (fs::path(folder_) / fmt::format("round_{:08d}.safetensors", step)).string();
}

bool SelfTraining::due(std::int64_t step) const {
  if (!session_.plan.semantics || (!rounds_.empty() && rounds_.back().step >= step)) return false;
  const std::vector<std::int64_t> all = round_steps(session_.config);
  return std::find(all.begin(), all.end(), step) != all.end();
}

std::int64_t SelfTraining::steps_until_due(std::int64_t step, std::int64_t most) const {
  for (const std::int64_t next : round_steps(session_.config)) {
    if (next > step) return std::min(most, next - step);
  }
  return most;
}

bool SelfTraining::make_round(std::int64_t step, const Hooks& hooks) {
  const SelfTrainingParams& params = session_.config.self_training;
  const auto confidence = static_cast<float>(params.confidence), opacity = static_cast<float>(params.min_opacity);
  SelfTrainingRound round;
  round.step = step;
  std::vector<LabelMap> labels;
  for (const int index : frames_) {
    if (hooks.stop && hooks.stop()) return false;
    const auto f = static_cast<std::size_t>(index);
    const FrameInfo& info = session_.scene.info.frames[f];
    const RayCamera camera{info.camera, info.world_from_camera, session_.plan.undistortion};
    FrameOptions options;
    if (hooks.progress) {
      options.progress = [&](double share) {
        hooks.progress({"train", static_cast<double>(labels.size()) + share, std::ssize(frames_)});
      };
    }
    const RenderedFrame seen = render_named_frame(*session_.pipeline, info.name, camera, session_.limits,
                                                  session_.plan.class_of_logit, {}, options);
    const TrainingLabels::Frame& own = session_.labels.frames[f];
    const LabelMap& truth = session_.scene.frames[f].label;
    std::vector<std::int16_t> added(seen.label.size(), kVoid);
    for (std::size_t p = 0; p < added.size(); ++p) {
      if (!own.empty() && own[p] != kVoid) continue;
      ++round.unlabelled_px;
      if (seen.confidence[p] < confidence || seen.opacity[p] < opacity) continue;
      added[p] = seen.label[p];
      ++round.added_px;
      if (truth.empty() || truth[p] == kVoid) continue;
      ++round.scored_px;
      round.right_px += truth[p] == added[p] ? 1 : 0;
    }
    labels.emplace_back(std::move(added));
  }
  std::swap(labels_, labels);
  rounds_.push_back(round);
  try {
    named_ = write(step);
  } catch (...) {
    std::swap(labels_, labels);  // those that the source borrows are again in their place
    rounds_.pop_back();
    throw;
  }
  rays_.add_labels(labels_);
  return true;
}

std::string SelfTraining::write(std::int64_t step) const {
  const std::size_t bytes = index_bytes(session_.classes());
  std::uint32_t crc = 0;
  std::vector<std::vector<std::uint8_t>> values(frames_.size());
  std::vector<TensorRef> tensors;
  for (std::size_t k = 0; k < frames_.size(); ++k) {
    const FrameInfo& info = session_.scene.info.frames[static_cast<std::size_t>(frames_[k])];
    values[k] = encode(labels_[k], pixels_of(info), bytes);
    crc = crc32c(std::as_bytes(std::span(values[k])), crc);
    tensors.push_back(tensor_ref(tensor_name(k, info),
                                 {info.camera.height_px, info.camera.width_px, static_cast<std::int64_t>(bytes)},
                                 std::span<const std::uint8_t>(values[k])));
  }
  create_folders(folder_);
  write_safetensors(path_of(step), tensors,
                    {{"format", kSelfLabelsFormat}, {"step", std::to_string(step)}, {"rounds", rounds_json(rounds_)}});
  return name_of_round(step, crc);
}

void SelfTraining::resume(std::int64_t step, const std::string& named) {
  if (is_folder(folder_)) {
    remove_stale_temporaries(folder_);
    for (const fs::directory_entry& entry : sorted_folder(folder_)) {
      const auto made = step_of_file(entry.path().filename().string());
      if (made && *made > step) fs::remove(entry.path());
    }
  }
  if (named.empty()) return;
  const std::string path = path_of(std::strtoll(named.c_str(), nullptr, 10));
  const TensorFile file = [&] {
    try {
      return TensorFile::read(path);
    } catch (const Error& error) {
      throw Error(error.kind(), error.code(), error.message() + "; the checkpoint was trained on the labels in it",
                  kRemedy);
    }
  }();
  const auto refuse = [&](const std::string& what) {
    throw Error(ErrorKind::data, "checkpoint.labels.damaged", fmt::format("'{}': {}", path, what), kRemedy);
  };
  const auto text = file.metadata().find("rounds");
  if (text == file.metadata().end()) refuse("it does not tell its rounds");
  std::vector<SelfTrainingRound> rounds = parse_rounds(text->second, path);
  if (rounds.empty() || rounds.back().step > step) refuse("it is of another step than its name says");
  const std::size_t bytes = index_bytes(session_.classes());
  std::uint32_t crc = 0;
  std::vector<LabelMap> labels;
  for (std::size_t k = 0; k < frames_.size(); ++k) {
    const FrameInfo& info = session_.scene.info.frames[static_cast<std::size_t>(frames_[k])];
    const TensorRef* tensor = file.find(tensor_name(k, info));
    if (tensor == nullptr || tensor->type != TensorType::u8 || tensor->bytes.size() != pixels_of(info) * bytes)
      refuse(fmt::format("frame '{}' is missing, or of another size", info.name));
    crc = crc32c(tensor->bytes, crc);
    labels.push_back(
        decode(tensor->bytes, bytes, session_.classes(), fmt::format("'{}', frame '{}'", path, info.name)));
  }
  labels_ = std::move(labels);
  rounds_ = std::move(rounds);
  named_ = name_of_round(rounds_.back().step, crc);
  if (named_ != named) refuse("its labels are not those that the checkpoint was trained on");
  rays_.add_labels(labels_);
}

}  // namespace semfield
