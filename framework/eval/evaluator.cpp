#include "eval/evaluator.h"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <limits>
#include <new>
#include <set>

#include "compute/isa.h"
#include "compute/parallel.h"
#include "core/check.h"
#include "core/checksum.h"
#include "core/error.h"
#include "core/text.h"
#include "eval/photo_edges.h"
#include "execution/render_rays.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {
constexpr std::int64_t kChunkRays = 8192;  // rays a render call; results do not depend on it
constexpr std::int64_t kLeastRays = 64;    // below it a call that gets no memory is given up

// Rays of some pixels on their way into a call.
struct RayBuffers {
  RayBuffers(std::int64_t rays, std::size_t logits)
      : origin(3 * static_cast<std::size_t>(rays)),
        direction(3 * static_cast<std::size_t>(rays)),
        near_far(2 * static_cast<std::size_t>(rays)),
        cosine(static_cast<std::size_t>(rays)),
        resolution(static_cast<std::size_t>(rays)),
        probability(logits * static_cast<std::size_t>(rays)) {}
  std::vector<double> origin, direction, near_far, cosine;
  std::vector<OpacityResolution> resolution;
  std::vector<float> probability;  // a column a logit
};

// Calls render(begin, end, buffers) over all pixels, chunk by chunk; without memory for a chunk, by half of it.
// `logits`: columns of RayBuffers::probability.
template <class Render>
void in_chunks(std::int64_t pixels, std::size_t logits, const Render& render) {
  std::int64_t chunk = kChunkRays;
  for (std::int64_t begin = 0; begin < pixels;) {
    try {
      RayBuffers buffers(chunk, logits);
      for (; begin < pixels; begin += chunk) render(begin, std::min(begin + chunk, pixels), buffers);
    } catch (const std::bad_alloc&) {
      if (chunk / 2 < kLeastRays) throw;
      chunk /= 2;
    }
  }
}

std::optional<double> value_of(const std::optional<Auroc>& found) {
  return found ? std::optional(found->value) : std::nullopt;
}

std::int32_t columns_of(const Pipeline<float>& pipeline, const std::string& channel) {
  for (const HeadParts<float>& head : pipeline.passes().back().parts().heads)
    if (head.channel == channel) return head.head->width();
  throw Error(ErrorKind::usage, "render.channel.unknown", "the run has no head that makes a channel '" + channel + "'",
              "see the list `heads` of its run.yaml");
}

using NamedValues = std::vector<std::pair<std::string, std::optional<double>>>;

void add_detail(NamedValues& out, const std::string& prefix, const LabelDetail& detail) {
  if (!detail.specks()) return;
  out.emplace_back(prefix + "border_miou", detail.border.miou_present());
  out.emplace_back(prefix + "border_accuracy", detail.border.total_accuracy());
  out.emplace_back(prefix + "specks", detail.specks());
}

// Labels that a frame trained with, at the pixels scored; empty for a frame without any.
std::vector<std::int16_t> given_labels(const EvalJob& job, int frame) {
  const TrainingLabels::Frame& labels = job.given->frames[static_cast<std::size_t>(frame)];
  const Camera& camera = (*job.infos)[static_cast<std::size_t>(frame)].camera;
  std::vector<std::int16_t> given(labels.empty() ? 0 : labels.size());
  for (std::size_t i = 0; i < given.size(); ++i) given[i] = labels[i];
  return strided(std::move(given), camera.width_px, camera.height_px, 1, job.stride);
}
// Of the pixels that are not masked; labels and depth of the others are void and invalid already.
void add_colors(ColorError& error, const std::vector<float>& truth, const std::vector<float>& predicted,
                const std::vector<std::uint8_t>& used) {
  if (used.empty()) return error.add(truth, predicted);
  std::vector<float> kept[2];
  for (std::size_t i = 0; i < truth.size(); ++i) {
    if (used[i / 3] == 0) continue;
    kept[0].push_back(truth[i]);
    kept[1].push_back(predicted[i]);
  }
  error.add(kept[0], kept[1]);
}
}  // namespace

RenderedFrame render_frame(Pipeline<float>& pipeline, const RayCamera& camera, const RayLimits& limits,
                           const ClassOfLogit& class_of_logit, const std::vector<std::int16_t>& truth,
                           const FrameOptions& options) {
  const WorkScope scope(pipeline.options().work);
  SEMFIELD_CHECK(options.stride >= 1 && options.stride <= std::min(camera.camera.width_px, camera.camera.height_px),
                 "a stride is at most the frame's shorter side");
  const ComputeFloatMode mode;
  RenderedFrame frame;
  frame.stride = options.stride;
  frame.width_px = strided_px(camera.camera.width_px, options.stride);
  frame.height_px = strided_px(camera.camera.height_px, options.stride);
  const std::int64_t pixels = std::int64_t{frame.width_px} * frame.height_px;
  const auto size = static_cast<std::size_t>(pixels);
  const bool semantics = pipeline.has_semantics();
  if (options.color) frame.rgb.resize(3 * size);
  frame.depth_m.resize(size);
  frame.opacity.resize(size);
  std::vector<std::int16_t> truth_logit;
  if (semantics) {
    frame.label.resize(size);
    frame.entropy.resize(size);
    frame.confidence.resize(size);
    if (!truth.empty()) {
      frame.truth_probability.resize(size);
      truth_logit.resize(size, kVoid);
      for (std::size_t i = 0; i < size; ++i) {
        const auto logit = std::find(class_of_logit.begin(), class_of_logit.end(), static_cast<int>(truth[i]));
        if (truth[i] >= 0 && logit != class_of_logit.end())
          truth_logit[i] = static_cast<std::int16_t>(logit - class_of_logit.begin());
      }
    }
  }
  const std::size_t logits = semantics && options.probability ? class_of_logit.size() : 0;
  const auto classes = static_cast<std::size_t>(options.classes);
  SEMFIELD_CHECK(logits <= classes,
                 "FrameOptions::classes counts the scene's classes where probabilities are asked for");
  if (logits > 0) frame.probability.resize(classes * size);
  for (const std::string& name : options.channels) {
    const std::int32_t cols = columns_of(pipeline, name);
    frame.channels.push_back({name, frame.height_px, frame.width_px, cols, {}});
    frame.channels.back().values.resize(static_cast<std::size_t>(cols) * size);
  }
  in_chunks(pixels, logits, [&](std::int64_t begin, std::int64_t end, RayBuffers& rays) {
    const std::int64_t count = end - begin;
    for (std::int64_t i = 0; i < count; ++i) {
      const auto [column, row] = strided_place(begin + i, frame.width_px, options.stride);
      const auto k = static_cast<std::size_t>(i);
      rays.cosine[k] =
          cast_ray(camera, limits, column, row, &rays.origin[3 * k], &rays.direction[3 * k], &rays.near_far[2 * k]);
    }
    RenderJob<float> job;
    job.origin = {rays.origin.data(), count, 3};
    job.direction = {rays.direction.data(), count, 3};
    job.near_far = {rays.near_far.data(), count, 2};
    if (options.color) job.color = {frame.rgb.data() + 3 * begin, count, 3};
    job.depth = {frame.depth_m.data() + begin, count, 1};
    job.opacity = {frame.opacity.data() + begin, count, 1};
    job.resolution = {rays.resolution.data(), count, 1};
    job.footprint_per_m = 1 / std::max(camera.camera.fx, camera.camera.fy);
    if (semantics) {
      job.label = {frame.label.data() + begin, count, 1};
      job.entropy = {frame.entropy.data() + begin, count, 1};
      job.confidence = {frame.confidence.data() + begin, count, 1};
      if (!truth_logit.empty()) {
        job.truth = {truth_logit.data() + begin, count, 1};
        job.truth_probability = {frame.truth_probability.data() + begin, count, 1};
      }
      if (logits > 0) job.probability = {rays.probability.data(), count, static_cast<std::int32_t>(logits)};
    }
    for (FrameChannel& one : frame.channels)
      job.heads.set(one.name, {one.values.data() + begin * one.cols, count, one.cols});
    try {
      pipeline.executor().render(job);
    } catch (const RayFault& fault) {
      const auto [column, row] = strided_place(begin + fault.ray(), frame.width_px, options.stride);
      throw Error(fault.kind(), fault.code(), fmt::format("pixel x {}, y {}: {}", column, row, fault.message()),
                  fault.remedy());
    }
    for (std::int64_t i = 0; i < count; ++i) {
      frame.depth_m[static_cast<std::size_t>(begin + i)] *=
          static_cast<float>(rays.cosine[static_cast<std::size_t>(i)]);
      const OpacityResolution found = rays.resolution[static_cast<std::size_t>(i)];
      frame.resolution.opaque_px += found == OpacityResolution::clear ? 0 : 1;
      frame.resolution.under_resolved_px += found == OpacityResolution::under_resolved ? 1 : 0;
      const std::size_t row = classes * static_cast<std::size_t>(begin + i);
      for (std::size_t k = 0; k < logits; ++k) {
        frame.probability[row + static_cast<std::size_t>(class_of_logit[k])] =
            rays.probability[logits * static_cast<std::size_t>(i) + k];
      }
    }
    if (options.progress) options.progress(static_cast<double>(end) / static_cast<double>(pixels));
  });
  for (float& value : frame.rgb) value = std::clamp(value, 0.0F, 1.0F);
  for (std::int16_t& label : frame.label)
    label = static_cast<std::int16_t>(class_of_logit[static_cast<std::size_t>(label)]);
  return frame;
}

RenderedFrame render_named_frame(Pipeline<float>& pipeline, const std::string& name, const RayCamera& camera,
                                 const RayLimits& limits, const ClassOfLogit& class_of_logit,
                                 const std::vector<std::int16_t>& truth, const FrameOptions& options) {
  try {
    return render_frame(pipeline, camera, limits, class_of_logit, truth, options);
  } catch (Error& error) {
    throw error.while_doing("while rendering frame '" + name + "'");
  }
}

bool FrameScore::worse_than(const FrameScore& other) const {
  if (miou_present && other.miou_present) return *miou_present < *other.miou_present;
  return psnr_db && other.psnr_db && *psnr_db < *other.psnr_db;
}

std::string OpacityCounts::warning() const {
  if (share().value_or(0) <= kTold) return {};
  return fmt::format(
      "{:.0f} % of the pixels that meet something take 90 % of their opacity from one or two steps longer than a pixel "
      "is wide there (under_resolved): thin matter can be missed and surfaces lie anywhere within a step; raise the "
      "sampler's samples (max_samples, or a smaller step_m, for an occupancy grid), or add an importance pass",
      100 * *share());
}

std::optional<double> SplitScore::ssim() const {
  if (ssim_frames == 0) return std::nullopt;
  return ssim_sum / static_cast<double>(ssim_frames);
}

std::vector<std::pair<std::string, std::optional<double>>> SplitScore::values() const {
  std::vector<std::pair<std::string, std::optional<double>>> out;
  out.emplace_back("psnr", color.psnr_db());
  out.emplace_back("ssim", ssim());
  if (fitted_color.values() > 0) out.emplace_back("psnr_fitted_colors", fitted_color.psnr_db());
  if (confusion.classes() > 0) {
    out.emplace_back("miou", confusion.miou());
    out.emplace_back("miou_present", confusion.miou_present());
    out.emplace_back("total_accuracy", confusion.total_accuracy());
    out.emplace_back("average_accuracy", confusion.average_accuracy());
    out.emplace_back("ece", calibration.ece());
    out.emplace_back("nll", calibration.nll());
    out.emplace_back("entropy_auroc", value_of(entropy.detects_wrong()));
    add_detail(out, "", detail);
  }
  if (photo_confusion.scored_px() > 0) {
    out.emplace_back("photo_miou_present", photo_confusion.miou_present());
    out.emplace_back("photo_total_accuracy", photo_confusion.total_accuracy());
    out.emplace_back("photo_ece", photo_calibration.ece());
    add_detail(out, "photo_", photo_detail);
  }
  if (given.pixels() > 0) {
    out.emplace_back("given_right_px", static_cast<double>(given.right.pixels()));
    out.emplace_back("given_wrong_px", static_cast<double>(given.wrong.pixels()));
    out.emplace_back("given_none_px", static_cast<double>(given.none.pixels()));
    out.emplace_back("given_right_entropy", given.right.mean());
    out.emplace_back("given_wrong_entropy", given.wrong.mean());
    out.emplace_back("given_none_entropy", given.none.mean());
    out.emplace_back("given_wrong_auroc", value_of(given.detects_wrong()));
    out.emplace_back("given_none_auroc", value_of(given.detects_none()));
  }
  if (depth.valid_truth_px() > 0) {
    out.emplace_back("absrel", depth.abs_rel());
    out.emplace_back("absdiff", depth.abs_diff());
    out.emplace_back("sqrel", depth.sq_rel());
    out.emplace_back("rmse", depth.rmse());
    out.emplace_back("delta1", depth.delta(1));
    out.emplace_back("delta2", depth.delta(2));
    out.emplace_back("delta3", depth.delta(3));
    out.emplace_back("depth_coverage", depth.coverage());
  }
  out.emplace_back("under_resolved", resolution.share());
  return out;
}

SplitScore evaluate(Pipeline<float>& pipeline, const EvalJob& job, const RayLimits& limits,
                    const ClassOfLogit& class_of_logit) {
  const WorkScope scope(pipeline.options().work);
  const bool semantics = pipeline.has_semantics();
  SplitScore score(semantics ? job.classes : 0, limits.far_m);
  std::function<void(double)> part_done;
  if (job.progress) part_done = [&](double share) { job.progress(static_cast<double>(score.frames.size()) + share); };
  for (const int index : job.frames) {
    if (job.stop && job.stop()) break;
    const FrameInfo& info = (*job.infos)[static_cast<std::size_t>(index)];
    const StoredFrame& stored = (*job.buffers)[static_cast<std::size_t>(index)];
    const RayCamera camera{info.camera, info.world_from_camera, job.undistort};
    const std::int32_t width = info.camera.width_px, height = info.camera.height_px;
    const std::vector<std::int16_t> truth = strided(stored.label.expand(), width, height, 1, job.stride);
    FrameOptions options;
    options.stride = job.stride;
    options.progress = part_done;
    options.classes = job.classes;
    options.probability = semantics && job.stride == 1 && !truth.empty();
    const RenderedFrame frame = render_named_frame(pipeline, info.name, camera, limits, class_of_logit, truth, options);
    const std::vector<std::uint8_t> stored_rgb = strided(stored.rgb, width, height, 3, job.stride);
    std::vector<float> truth_rgb(stored_rgb.size());
    for (std::size_t i = 0; i < truth_rgb.size(); ++i) truth_rgb[i] = static_cast<float>(stored_rgb[i]) / 255.0F;
    ColorError color, fitted;
    std::optional<double> similarity;
    const std::vector<std::uint8_t> used = strided(stored.mask.expand(), width, height, 1, job.stride);
    if (job.stride == 1) similarity = ssim(truth_rgb, frame.rgb, frame.width_px, frame.height_px, 3, used);
    ConfusionMatrix confusion(semantics ? job.classes : 0), photo_confusion(confusion);
    LabelDetail detail(confusion.classes()), photo_detail(detail);
    Calibration calibration, photo_calibration;
    LabelEntropy entropy, given;
    DepthError depth(limits.far_m);
    const bool labels = semantics && !truth.empty();
    PhotoLabels photo;
    if (labels && job.stride == 1) photo = labels_on_photo(frame, job.classes, stored.rgb, width, height);
    std::vector<std::function<void()>> measures{[&] { add_colors(color, truth_rgb, frame.rgb, used); }};
    const auto measure = [&](bool wanted, std::function<void()> add) {
      if (wanted) measures.push_back(std::move(add));
    };
    measure(job.fit_colors,
            [&] { add_colors(fitted, truth_rgb, fitted_by_halves(truth_rgb, frame.rgb, frame.width_px, used), used); });
    measure(labels, [&] { confusion.add(truth, frame.label); });
    measure(labels && job.stride == 1, [&] { detail.add(truth, frame.label, frame.width_px); });
    measure(!photo.label.empty(), [&] { photo_confusion.add(truth, photo.label); });
    measure(!photo.label.empty(), [&] { photo_detail.add(truth, photo.label, width); });
    // Their likelihood is not asked for.
    measure(!photo.label.empty(),
            [&] { photo_calibration.add(photo.confidence, photo.confidence, photo.label, truth); });
    measure(labels, [&] { calibration.add(frame.confidence, frame.truth_probability, frame.label, truth); });
    measure(labels, [&] { entropy.add(frame.entropy, frame.label, truth); });
    measure(labels && job.given != nullptr, [&] { given.add(frame.entropy, given_labels(job, index), truth); });
    measure(!stored.depth_m.empty(),
            [&] { depth.add(strided(stored.depth_m.expand(), width, height, 1, job.stride), frame.depth_m); });
    parallel_for(std::ssize(measures), [&](std::int64_t i) { measures[static_cast<std::size_t>(i)](); });
    score.pixels += std::int64_t{frame.width_px} * frame.height_px;
    score.resolution.opaque_px += frame.resolution.opaque_px;
    score.resolution.under_resolved_px += frame.resolution.under_resolved_px;
    FrameScore row;
    row.frame = index;
    row.name = info.name;
    row.psnr_db = color.psnr_db();
    score.color.merge(color);
    score.fitted_color.merge(fitted);
    if (similarity) {
      score.ssim_sum += *similarity;
      ++score.ssim_frames;
    }
    if (labels) {
      row.miou_present = confusion.miou_present();
      score.confusion.merge(confusion);
      score.detail.merge(detail);
      score.photo_confusion.merge(photo_confusion);
      score.photo_detail.merge(photo_detail);
      score.photo_calibration.merge(photo_calibration);
      score.calibration.merge(calibration);
      score.entropy.merge(entropy);
      score.given.merge(given);
    }
    if (!stored.depth_m.empty()) {
      row.absrel = depth.abs_rel();
      score.depth.merge(depth);
    }
    score.frames.push_back(std::move(row));
    if (job.on_frame) job.on_frame(score.frames.back(), frame);
  }
  return score;
}

std::vector<int> evenly_spaced(const std::vector<int>& all, int count) {
  const auto have = static_cast<int>(all.size());
  if (count >= have) return all;
  std::vector<int> chosen;
  for (int i = 0; i < count; ++i) chosen.push_back(all[static_cast<std::size_t>((2 * i + 1) * have / (2 * count))]);
  return chosen;
}

void EvalBudget::spend(double seconds, double pixels) {
  SEMFIELD_CHECK(seconds >= 0 && pixels > 0, "an evaluation has pixels");
  spent_s_ += seconds;
  s_per_px_ = seconds / pixels;
}

std::int32_t EvalBudget::sample_stride(double pixels, double every_s, std::int32_t most) const {
  return bounds_samples() ? stride_within(share_ / 2 * every_s, pixels, most) : 1;
}

double EvalBudget::left_s(double train_s) const {
  if (!bounds_last()) return std::numeric_limits<double>::infinity();
  // A step that runs over the time, or samples that did, still leave it half of the share.
  return std::max((1 + share_) * time_s_ - train_s - spent_s_, share_ / 2 * time_s_);
}

std::int32_t EvalBudget::stride_within(double budget_s, double pixels, std::int32_t most) const {
  const double cost_s = pixels * s_per_px_;
  std::int32_t stride = 1;
  while (stride < most && cost_s / (static_cast<double>(stride) * stride) > budget_s) ++stride;
  return stride;
}

double cast_ray(const RayCamera& camera, const RayLimits& limits, std::int32_t column, std::int32_t row, double* origin,
                double* direction, double* near_far) {
  const Camera& c = camera.camera;
  const double u = column + 0.5, v = row + 0.5;
  const Vec3d local = camera.undistort ? c.direction(u, v) : pinhole_direction(c.fx, c.fy, c.cx, c.cy, u, v);
  return ray_of_direction(local, camera.world_from_camera, {c.has_finite_lens(), c.is_wide()}, limits, origin,
                          direction, near_far);
}

namespace {

const std::string kSceneVoid = "pixels whose true class the scene ignores are void";
const std::string kListVoid = "pixels whose true class is none of the list are void";

std::vector<std::string> names_of(const std::string& published) {
  std::vector<std::string> names;
  const ClassTable table = published_classes(published);
  for (int c = 0; c < table.valid_count(); ++c) names.push_back(table.valid(c).name);
  return names;
}

const std::vector<Protocol>& protocols() {
  static const std::vector<Protocol> all{{"semantic_nerf", "Zhi21", {}, kSceneVoid},
                                         {"panoptic_lifting", "Siddiqui23", {}, kSceneVoid},
                                         {"scannet20", "Dai17", names_of("scannet20"), kListVoid},
                                         {"nyu40", "Gupta13", names_of("nyu40"), kListVoid}};
  return all;
}

std::string compared_name(std::string name) {
  for (char& c : name) c = c == '-' || c == '_' ? ' ' : static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return name == "refridgerator" ? "refrigerator" : name;  // as ScanNet's table spells it
}

}  // namespace

std::vector<std::string> protocol_names() {
  std::vector<std::string> names;
  for (const Protocol& protocol : protocols()) names.push_back(protocol.name);
  return names;
}

Protocol protocol_named(const std::string& name) {
  for (const Protocol& protocol : protocols())
    if (protocol.name == name) return protocol;
  throw Error(ErrorKind::usage, "eval.protocol.unknown", "unknown protocol '" + name + "'",
              "one of " + join(protocol_names()));
}

ProtocolScore protocol_score(const Protocol& protocol, const ConfusionMatrix& confusion, const ClassTable& classes) {
  std::set<std::string> listed;
  for (const std::string& name : protocol.classes) listed.insert(compared_name(name));
  ProtocolScore out{protocol, {}, {}, 0, {}, {}, {}};
  std::vector<int> counted;
  for (int c = 0; c < classes.valid_count(); ++c) {
    const std::string& name = classes.valid(c).name;
    if (!protocol.classes.empty() && listed.count(compared_name(name)) == 0) {
      out.void_classes.push_back(name);
      continue;
    }
    counted.push_back(c);
    out.classes.push_back({name, 0, {}});
  }
  if (counted.empty())
    throw Error(ErrorKind::data, "eval.protocol.classes",
                fmt::format("no class of the scene is one of {}: {}", protocol.name, join(out.void_classes)),
                "name the classes of the scene's table as `semfield labels classes " + protocol.name + "` does");
  double iou_sum = 0, recall_sum = 0;
  std::int64_t right = 0;
  int present = 0;
  for (std::size_t k = 0; k < counted.size(); ++k) {
    std::int64_t truth = 0, predicted = 0;
    for (int other = 0; other < classes.valid_count(); ++other) truth += confusion.count(counted[k], other);
    for (const int other : counted) predicted += confusion.count(other, counted[k]);
    const std::int64_t both = confusion.count(counted[k], counted[k]);
    out.classes[k].truth_px = truth;
    if (truth == 0) continue;
    out.classes[k].iou = static_cast<double>(both) / static_cast<double>(truth + predicted - both);
    iou_sum += *out.classes[k].iou;
    recall_sum += static_cast<double>(both) / static_cast<double>(truth);
    out.scored_px += truth;
    right += both;
    ++present;
  }
  if (present == 0) return out;
  out.miou = iou_sum / present;
  out.average_accuracy = recall_sum / present;
  out.total_accuracy = static_cast<double>(right) / static_cast<double>(out.scored_px);
  return out;
}

std::string truth_hash(std::span<const int> frames, const std::vector<FrameInfo>& infos,
                       const std::vector<StoredFrame>& stored, const ClassTable& classes) {
  std::uint32_t crc = 0;
  for (const int f : frames) {
    const FrameInfo& info = infos[static_cast<std::size_t>(f)];
    const std::string head = fmt::format("{}\n{} {}\n", info.name, info.camera.width_px, info.camera.height_px);
    crc = crc32c(std::as_bytes(std::span(head)), crc);
    std::vector<std::int32_t> ids;
    for (const std::int16_t label : stored[static_cast<std::size_t>(f)].label.expand())
      ids.push_back(label == kVoid ? -1 : classes.valid(label).id);
    crc = crc32c(std::as_bytes(std::span(ids)), crc);
  }
  return fmt::format("{:08x}", crc);
}

namespace {

void require_finite(std::span<const Vec3d> vectors, const char* what) {
  for (std::size_t i = 0; i < vectors.size(); ++i) {
    const Vec3d& v = vectors[i];
    if (!std::isfinite(v.x) || !std::isfinite(v.y) || !std::isfinite(v.z))
      throw Error(ErrorKind::data, "usage.points.not_finite",
                  fmt::format("{} {}: ({}, {}, {}) is not finite", what, i, v.x, v.y, v.z), "leave such rows out");
  }
}

bool inside(const Box& box, const Vec3d& p) {
  return p.x >= box.lo.x && p.x <= box.hi.x && p.y >= box.lo.y && p.y <= box.hi.y && p.z >= box.lo.z && p.z <= box.hi.z;
}

}  // namespace

FieldPoints field_at(Pipeline<float>& pipeline, std::span<const Vec3d> positions, std::span<const Vec3d> directions,
                     const RayLimits& limits, const ClassOfLogit& class_of_logit, int classes) {
  static_assert(sizeof(Vec3d) == 3 * sizeof(double));
  SEMFIELD_CHECK(directions.empty() || directions.size() == positions.size(), "a direction for every position");
  const WorkScope scope(pipeline.options().work);
  const ComputeFloatMode mode;
  require_finite(positions, "position");
  require_finite(directions, "direction");
  FieldPoints out;
  if (positions.empty()) return out;
  const auto count = std::ssize(positions);
  out.sigma.resize(positions.size());
  PointQuery<float> query;
  query.position = {&positions.data()->x, count, 3};
  query.sigma = {out.sigma.data(), count, 1};
  if (!directions.empty()) {
    out.rgb.resize(3 * positions.size());
    query.direction = {&directions.data()->x, count, 3};
    query.color = {out.rgb.data(), count, 3};
  }
  const auto logits = static_cast<std::int32_t>(class_of_logit.size());
  std::vector<float> values(pipeline.has_semantics() ? positions.size() * class_of_logit.size() : 0);
  if (!values.empty()) query.logits = {values.data(), count, logits};
  query_points(pipeline, query);
  for (float& value : out.rgb) value = std::clamp(value, 0.0F, 1.0F);
  if (limits.clip)
    for (std::size_t i = 0; i < positions.size(); ++i)
      if (!inside(limits.bounds, positions[i])) out.sigma[i] = 0;
  if (values.empty()) return out;
  out.label.resize(positions.size());
  out.entropy.resize(positions.size());
  ClassResults<float> results;
  results.label = {out.label.data(), count, 1};
  results.entropy = {out.entropy.data(), count, 1};
  cpu_stages<float>().class_results(query.logits, results);  // values are probabilities from here on
  out.probability.resize(positions.size() * static_cast<std::size_t>(classes));
  for (std::size_t i = 0; i < positions.size(); ++i) {
    out.label[i] = static_cast<std::int16_t>(class_of_logit[static_cast<std::size_t>(out.label[i])]);
    for (std::size_t k = 0; k < class_of_logit.size(); ++k)
      out.probability[i * static_cast<std::size_t>(classes) + static_cast<std::size_t>(class_of_logit[k])] =
          values[i * class_of_logit.size() + k];
  }
  return out;
}

}  // namespace semfield
