#include "train/assembly.h"

#include <fmt/format.h>

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <map>

#include "compute/parallel.h"
#include "config/config_tree.h"
#include "core/check.h"
#include "core/error.h"
#include "execution/ranks_executor.h"
#include "train/session.h"

namespace semfield {

namespace {

// The maker of the slot's plugin for Real, one overload a kind.
template <class Real, class Kind32, class Kind64, class Build>
auto make(const Kind32& maker32, const Kind64& maker64, const PluginSlot& slot, const Build& build,
          const Registry& registry) {
  if constexpr (std::is_same_v<Real, float>) {
    return maker32(*slot.params, build, registry.kernels());
  } else {
    return maker64(*slot.params, build, registry.kernels());
  }
}

EncoderBuild encoder_build(const SceneExtent& extent, bool is_direction, Device device) {
  const Vec3d size = extent.bounds.empty() ? Vec3d{} : extent.bounds.size();
  // Contracted, the bounds take half of an encoder's cube.
  return {.device = device,
          .is_direction = is_direction,
          .extent_m = (extent.contracted ? 2 : 1) * std::max({size.x, size.y, size.z}),
          .pixel_footprint_m = extent.pixel_footprint_m};
}

template <class Real>
std::unique_ptr<Encoder<Real>> make_encoder(const PluginSlot& slot, const Registry& registry, const SceneExtent& extent,
                                            bool is_direction, Device device, const std::string& path) {
  std::unique_ptr<Encoder<Real>> encoder = make<Real>(slot.entry->encoder32, slot.entry->encoder64, slot,
                                                      encoder_build(extent, is_direction, device), registry);
  const EncoderTraits traits = encoder->traits();
  if (traits.in_dims != 3) {
    throw Error(ErrorKind::config, "config.encoder.inputs",
                path + ": encoder '" + slot.entry->name + "' reads " + std::to_string(traits.in_dims) +
                    " coordinates, but the scene has 3");
  }
  if (!is_direction && traits.domain == Domain::direction) {
    throw Error(ErrorKind::config, "config.encoder.domain",
                path + ": encoder '" + slot.entry->name + "' encodes unit directions, not positions",
                "choose a position encoder, or move it to 'direction'");
  }
  if (is_direction && traits.domain == Domain::unit_cube) {
    throw Error(ErrorKind::config, "config.encoder.domain",
                path + ": encoder '" + slot.entry->name + "' encodes positions in a cube, not directions",
                "choose a direction encoder");
  }
  return encoder;
}

// Those whose defaults learn nothing, for the position of a semantic branch.
std::vector<std::string> smooth_encoders(const Registry& registry) {
  std::vector<std::string> names;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != PluginKind::encoder) continue;
    const auto encoder = entry->encoder32(*entry->new_params(), {}, registry.kernels());
    if (encoder->traits().domain != Domain::direction && !learns<float>(*encoder)) names.push_back(entry->name);
  }
  return names;
}

// What the parts of a pass are made for.
struct PassBuild {
  const RunConfig& config;
  const Registry& registry;
  const BuildPlan& plan;
  const SceneExtent& extent;
  Device device;
};

// The plugins of a branch, which are below `key` in the configuration.
struct BranchSlots {
  std::string key;
  const PluginSlot& position;
  const PluginSlot& field;
  const BranchRules& rules;
};

template <class Real>
std::unique_ptr<BranchParts<Real>> make_branch(const BranchSlots& branch, const PassBuild& build,
                                               std::int32_t feature_dims) {
  auto parts = std::make_unique<BranchParts<Real>>();
  parts->rules = branch.rules;
  parts->position =
      make_encoder<Real>(branch.position, build.registry, build.extent, false, build.device, branch.key + ".position");
  if (learns<Real>(*parts->position)) {
    throw Error(ErrorKind::config, "config.encoder.learned",
                branch.key + ".position: '" + branch.position.entry->name +
                    "' has learned tensors, and the branch is to be smoother than such tables",
                "choose an encoder without learned tensors: " + join(smooth_encoders(build.registry)));
  }
  parts->domain = DomainMap::make(parts->position->traits().domain, build.extent.bounds,
                                  build.config.rendering.scene_scale, build.extent.contracted);
  const FieldBuild field{
      .device = build.device,
      .position_dims = parts->position->traits().out_dims + (branch.rules.reads_feature ? feature_dims : 0),
      .feature_only = true,
      .precision = build.config.runtime.precision};
  parts->field =
      make<Real>(branch.field.entry->field32, branch.field.entry->field64, branch.field, field, build.registry);
  return parts;
}

template <class Real>
HeadParts<Real> make_head(const HeadConfig& head, const PassBuild& build, std::int32_t feature_dims) {
  HeadParts<Real> parts;
  parts.channel = head.channel;
  parts.source_width = head.source_width;
  parts.branch = make_branch<Real>({head.key + ".branch", head.position, head.field, head.rules}, build, feature_dims);
  const HeadBuild own{build.device, parts.branch->field->traits().feature_dims, head.width};
  parts.head = make<Real>(head.head.entry->head32, head.head.entry->head64, head.head, own, build.registry);
  return parts;
}

template <class Real>
std::unique_ptr<Sampler<Real>> make_sampler(const PluginSlot& slot, const Registry& registry, const SceneExtent& extent,
                                            Device device) {
  const SamplerBuild build{.device = device, .bounds = extent.bounds, .near_m = extent.near_m, .far_m = extent.far_m};
  return make<Real>(slot.entry->sampler32, slot.entry->sampler64, slot, build, registry);
}

// `sampler` as in make_parts, null for the earlier passes.
template <class Real>
PassParts<Real> make_pass(std::size_t number, const PassBuild& build, std::unique_ptr<Sampler<Real>> sampler) {
  const RunConfig& config = build.config;
  const Registry& registry = build.registry;
  const PassConfig& pass = config.passes[number];
  const SceneExtent& extent = build.extent;
  const bool last = number + 1 == config.passes.size(), semantics = build.plan.semantics;
  PassParts<Real> parts;
  parts.name = pass.name;
  parts.number = static_cast<std::uint32_t>(number);
  parts.stages = &stages_of<Real>(build.device);
  parts.sampler = sampler ? std::move(sampler) : make_sampler<Real>(pass.sampler, registry, extent, build.device);
  parts.position = make_encoder<Real>(pass.position, registry, extent, false, build.device, pass.key + ".position");
  if (build.plan.learned_poses > 0 && !parts.position->traits().gives_dx_alone && learns<Real>(*parts.position)) {
    throw Error(ErrorKind::config, "config.encoder.poses",
                pass.key + ".position: encoder '" + pass.position.entry->name +
                    "' has learned tensors and gives no gradient of positions by itself, so poses cannot be learned",
                "choose another encoder, or set train.cameras.poses: given");
  }
  parts.domain =
      DomainMap::make(parts.position->traits().domain, extent.bounds, config.rendering.scene_scale, extent.contracted);
  FieldBuild field_build;
  field_build.device = build.device;
  field_build.position_dims = parts.position->traits().out_dims;
  if (build.plan.view_branch && pass.direction.entry != nullptr) {
    parts.direction = make_encoder<Real>(pass.direction, registry, extent, true, build.device, pass.key + ".direction");
    field_build.direction_dims = parts.direction->traits().out_dims;
  }
  const bool by_branch = semantics && pass.branch() != nullptr;
  field_build.savings = {config.runtime.fold_feature_layer, config.runtime.direction_once_per_ray};
  field_build.precision = config.runtime.precision;
  parts.field = make<Real>(pass.field.entry->field32, pass.field.entry->field64, pass.field, field_build, registry);
  const std::int32_t feature_dims = parts.field->traits().feature_dims;
  for (std::size_t h = 0; last && h < config.heads.size(); ++h)
    parts.heads.push_back(make_head<Real>(config.heads[h], build, feature_dims));
  if (!semantics) return parts;
  const Field<Real>* read = parts.field.get();
  if (by_branch) {
    const SemanticBranchConfig& branch = *pass.branch();
    parts.branch = make_branch<Real>({pass.key + "." + branch.key, branch.position, branch.field, branch.rules}, build,
                                     feature_dims);
    read = parts.branch->field.get();
  }
  const HeadShape shape{.feature = read->traits().feature_dims,
                        .hidden = config.semantics.hidden_width,
                        .width = static_cast<std::int32_t>(build.plan.class_of_logit.size()),
                        .precision = config.runtime.precision};
  parts.head = std::make_unique<OneLayerHead<Real>>(shape, *parts.stages->head);
  return parts;
}

template <class Real>
std::vector<PassParts<Real>> make_passes(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                                         const SceneExtent& extent, Device device,
                                         std::unique_ptr<Sampler<Real>> last = {}) {
  const PassBuild build{config, registry, plan, extent, device};
  std::vector<PassParts<Real>> passes;
  for (std::size_t p = static_cast<std::size_t>(plan.first_pass); p < config.passes.size(); ++p) {
    const PassConfig& pass = config.passes[p];
    std::unique_ptr<Sampler<Real>> sampler;
    if (p + 1 == config.passes.size()) sampler = std::move(last);
    passes.push_back(make_pass<Real>(p, build, std::move(sampler)));
    if (passes.size() == 1 && passes.back().sampler->traits().needs_previous) {
      throw Error(ErrorKind::config, "config.sampler.order",
                  pass.key + ".sampler: '" + pass.sampler.entry->name +
                      "' refines the weights of an earlier pass, but this is the first",
                  "put a pass with another sampler before it");
    }
  }
  return passes;
}

PipelineOptions pipeline_options(const RunConfig& config, const BuildPlan& plan, const SceneExtent& extent) {
  PipelineOptions options;
  options.rules.rendering = config.rendering;
  if (config.rendering.unit_m > 0) options.rules.unit_m = config.rendering.unit_m;
  if (plan.late_samples) options.rules.rendering.early_stop = 0;
  options.rules.semantics = config.semantics;
  options.rules.deferred_class_layer = config.runtime.deferred_class_layer;
  options.seed = config.runtime.seed;
  options.tile_rays = config.runtime.tile_rays;
  options.rays = config.train.rays;
  options.lanes = config.runtime.lanes;
  options.losses = LossList(config.losses);
  CameraRules& cameras = options.cameras;
  cameras.count = std::max(plan.learned_poses, plan.learned_colors);
  cameras.poses = plan.learned_poses > 0;
  cameras.colors = plan.learned_colors > 0;
  cameras.pose_rate = config.cameras.pose_rate;
  cameras.color_rate = config.cameras.color_rate;
  cameras.from_step = config.cameras.from_step;
  const Vec3d size = extent.bounds.size();
  cameras.distance_m = 0.5 * std::max({size.x, size.y, size.z});
  options.head_on_all_rays = plan.head_on_unlabelled_rays;
  return options;
}

void say_slow_fields(const RunConfig& config, const std::vector<PassParts<float>>& passes, Diagnostics& diagnostics) {
  const auto say = [&](const std::string& where, const Field<float>& field) {
    const std::string found = field.slow_path();
    if (!found.empty()) diagnostics.warning("device.field.slow", where, found, {});
  };
  for (const PassParts<float>& pass : passes) {
    const PassConfig& written = config.passes[pass.number];
    say(written.key + ".field", *pass.field);
    if (pass.branch) say(written.key + "." + written.branch()->key + ".field", *pass.branch->field);
  }
}

using Matrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
using Floats = Eigen::Matrix<float, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;

constexpr std::int64_t kMostCells = 65536, kRowsAtOnce = 4096;

std::int64_t cells_of(const FrameChannel& map) { return std::int64_t{map.height} * map.width; }

std::vector<FrameChannel*> maps_of(Session& s, const std::string& channel) {
  std::vector<FrameChannel*> maps;
  for (const int f : s.scene.frames_of(Split::train)) {
    for (FrameChannel& one : s.scene.frames[static_cast<std::size_t>(f)].channels)
      if (one.name == channel && !one.values.empty()) maps.push_back(&one);
  }
  return maps;
}

constexpr const char* kIgnored = ", ignored";

// "'chair'" or "'void', ignored" by id.
std::map<std::int64_t, std::string> classes_by_id(const std::string& yaml) {
  std::map<std::int64_t, std::string> out;
  if (yaml.empty()) return out;
  ConfigNode list;
  try {
    list = parse_config_text(yaml, "checkpoint metadata 'classes'");
  } catch (const Error& error) {
    throw Error(ErrorKind::data, error.code(), error.message(),
                "resume from another checkpoint of the run: move this file out of the folder");
  }
  for (const ConfigNode& item : list.items()) {
    const ConfigNode *id = item.find("id"), *name = item.find("name"), *ignore = item.find("ignore");
    std::int64_t number = -1;
    if (id != nullptr) std::from_chars(id->text().data(), id->text().data() + id->text().size(), number);
    out[number] = fmt::format("'{}'{}", name == nullptr ? "" : name->text(),
                              ignore != nullptr && ignore->text() == "true" ? kIgnored : "");
  }
  return out;
}

}  // namespace

std::unique_ptr<Sampler<float>> make_last_sampler(const RunConfig& config, const Registry& registry,
                                                  const SceneExtent& extent) {
  return make_sampler<float>(config.passes.back().sampler, registry, extent, Device::cpu);
}

BuildRequest build_request(const RunConfig& config, const Registry& registry, const SamplerTraits& last_sampler) {
  BuildRequest request;
  request.last_sampler_single_pass = last_sampler.single_pass;
  request.empty_space = last_sampler.empty_space;
  request.passes = static_cast<int>(config.passes.size());
  request.last_pass = config.passes.back().key;
  request.direction_encoder = config.passes.back().direction.entry != nullptr;
  request.density_noise = config.rendering.density_noise;
  request.early_stop = config.rendering.early_stop;
  for (const PluginEntry* entry : registry.entries()) {
    if (entry->kind != PluginKind::loss) continue;
    const auto named = std::find_if(config.losses.begin(), config.losses.end(),
                                    [&](const LossEntry& one) { return one.type == entry->name; });
    const bool is_named = named != config.losses.end();
    request.losses.push_back({entry->name, entry->saves, is_named, is_named ? named->loss->traits() : LossTraits{}});
  }
  for (const HeadConfig& head : config.heads) request.heads.push_back(head.channel);
  request.balance_classes = config.semantics.balance_classes;
  request.mixed_precision = config.runtime.precision != Precision::fp32;
  request.learns_poses = config.cameras.poses == CameraTrust::learned;
  request.learns_colors = config.cameras.colors == CameraTrust::learned;
  request.periodic_evaluation = config.report.eval_every_s > 0;
  return request;
}

SceneExtent extent_of(const RunConfig& config, double pixel_footprint_m) {
  const std::vector<double>& b = config.load.bounds;
  return {{{b[0], b[1], b[2]}, {b[3], b[4], b[5]}},
          config.load.near_m,
          config.load.far_m,
          pixel_footprint_m,
          config.rendering.outside == Outside::contracted};
}

std::vector<std::string> choose_from_scene(RunConfig& config, const SceneExtent& extent, Device device) {
  std::vector<std::string> lines;
  EncoderBuild build = encoder_build(extent, false, device);
  if (!extent.bounds.empty()) {
    const DomainMap map =
        DomainMap::make(Domain::metric, extent.bounds, config.rendering.scene_scale, extent.contracted);
    if (extent.contracted) build.largest_coordinate = 1;
    for (int a = 0; a < 3 && !extent.contracted; ++a) {
      for (const double corner : {extent.bounds.lo[a], extent.bounds.hi[a]})
        build.largest_coordinate = std::max(build.largest_coordinate, std::abs(corner - map.center[a]) * map.scale);
    }
  }
  for (PassConfig& pass : config.passes) {
    std::vector<std::string> chosen;
    pass.position.params->choose(build, chosen);
    for (const std::string& sentence : chosen) lines.push_back(pass.key + ".position: " + sentence);
    if (pass.branch() == nullptr) continue;
    chosen.clear();
    pass.branch()->position.params->choose(build, chosen);
    for (const std::string& sentence : chosen)
      lines.push_back(pass.key + "." + pass.branch()->key + ".position: " + sentence);
  }
  for (HeadConfig& head : config.heads) {
    std::vector<std::string> chosen;
    head.position.params->choose(build, chosen);
    for (const std::string& sentence : chosen) lines.push_back(head.key + ".branch.position: " + sentence);
  }
  return lines;
}

template <class Real>
bool NetworkParts<Real>::needs_bounds() const {
  return std::any_of(passes.begin(), passes.end(),
                     [](const PassParts<Real>& pass) { return pass.position->traits().domain == Domain::unit_cube; });
}

template <class Real>
NetworkParts<Real> make_parts(const RunConfig& config, const Registry& registry, const BuildPlan& plan,
                              const SceneExtent& extent, std::unique_ptr<Sampler<Real>> last) {
  NetworkParts<Real> parts;
  parts.passes = make_passes<Real>(config, registry, plan, extent, Device::cpu, std::move(last));
  parts.options = settled(pipeline_options(config, plan, extent), parts.passes);
  parts.options.work.threads = config.runtime.threads;
  return parts;
}

template <class Real>
std::unique_ptr<Pipeline<Real>> assemble(NetworkParts<Real> parts, std::vector<float> class_weight, bool trainable) {
  parts.options.class_weight = std::move(class_weight);
  return std::make_unique<Pipeline<Real>>(std::move(parts.passes), std::move(parts.options), trainable);
}

void run_on(const RunOn& how, const RunConfig& config, const Registry& registry, const BuildPlan& plan,
            const SceneExtent& extent, Pipeline<float>& pipeline) {
  std::unique_ptr<Executor<float>> executor;  // a pipeline begins on the CPU
  const auto make = [&] {
    if (how.device.kind == Device::cpu) return;
    DeviceOptions options{how.device.ordinal, how.trainable, config.runtime.deterministic};
    options.kernels = &registry.kernels();
    options.ranks = how.ranks;
    std::vector<PassParts<float>> passes = make_passes<float>(config, registry, plan, extent, how.device.kind);
    if (how.diagnostics != nullptr) say_slow_fields(config, passes, *how.diagnostics);
    executor = cuda_library().make(pipeline, std::move(passes), options);
  };
  if (how.ranks != nullptr) {
    agree(*how.ranks, make);  // before there is an executor that tells the others of its end
  } else {
    make();
  }
  if (how.ranks != nullptr) executor = std::make_unique<RanksExecutor>(*how.ranks, pipeline, std::move(executor));
  if (executor) pipeline.run_on(std::move(executor));
}

#define SEMFIELD_INSTANTIATE(Real)                                                                  \
  template struct NetworkParts<Real>;                                                               \
  template NetworkParts<Real> make_parts<Real>(const RunConfig&, const Registry&, const BuildPlan&, \
                                               const SceneExtent&, std::unique_ptr<Sampler<Real>>); \
  template std::unique_ptr<Pipeline<Real>> assemble<Real>(NetworkParts<Real>, std::vector<float>, bool);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

std::vector<float> principal_axes(const std::vector<const FrameChannel*>& maps, std::int32_t width) {
  std::int64_t cells = 0;
  for (const FrameChannel* map : maps) cells += cells_of(*map);
  const std::int64_t step = std::max<std::int64_t>(1, (cells + kMostCells - 1) / kMostCells);
  const std::int32_t cols = maps.empty() ? width : maps.front()->cols;
  Matrix moment = Matrix::Zero(cols, cols), rows(kRowsAtOnce, cols);
  std::int64_t filled = 0, counted = 0;
  const auto add = [&] {
    moment.selfadjointView<Eigen::Lower>().rankUpdate(rows.topRows(filled).transpose());
    counted += filled;
    filled = 0;
  };
  std::int64_t number = 0;
  for (const FrameChannel* map : maps) {
    for (std::int64_t cell = 0; cell < cells_of(*map); ++cell, ++number) {
      if (number % step != 0) continue;
      const float* const row = map->values.data() + cell * cols;
      const auto value = Eigen::Map<const Eigen::RowVectorXf>(row, cols).cast<double>();
      const double norm = value.norm();
      if (!(norm > 0)) continue;
      rows.row(filled++) = value / norm;
      if (filled == kRowsAtOnce) add();
    }
  }
  add();
  if (counted == 0)
    throw Error(ErrorKind::data, "scene.channel.empty",
                fmt::format("channel '{}': every row that was looked at is zero",
                            maps.empty() ? std::string() : maps.front()->name),
                "write maps whose rows are not all zero, or take the head out of the list `heads`");
  const Eigen::SelfAdjointEigenSolver<Matrix> solver(moment / static_cast<double>(counted));
  std::vector<float> axes(static_cast<std::size_t>(cols) * static_cast<std::size_t>(width));
  for (std::int32_t k = 0; k < width; ++k) {
    const Eigen::VectorXd axis = solver.eigenvectors().col(cols - 1 - k);
    Eigen::Index largest = 0;
    axis.cwiseAbs().maxCoeff(&largest);
    const double sign = axis[largest] < 0 ? -1 : 1;
    for (std::int32_t c = 0; c < cols; ++c)
      axes[static_cast<std::size_t>(c) * static_cast<std::size_t>(width) + static_cast<std::size_t>(k)] =
          static_cast<float>(sign * axis[c]);
  }
  return axes;
}

void multiply_rows(FrameChannel& map, View<const float> matrix) {
  SEMFIELD_CHECK(map.cols == matrix.rows, "a channel is multiplied by a matrix with a row per column");
  const Eigen::Map<const Floats> from(map.values.data(), cells_of(map), map.cols);
  const Eigen::Map<const Floats> by(matrix.data, matrix.rows, matrix.cols);
  std::vector<float> to(static_cast<std::size_t>(cells_of(map)) * static_cast<std::size_t>(matrix.cols));
  Eigen::Map<Floats>(to.data(), cells_of(map), matrix.cols).noalias() = from * by;
  map.values = std::move(to);
  map.cols = matrix.cols;
}

std::vector<std::vector<float>> axes_of(const Session& session) {
  std::vector<std::vector<float>> all;
  const Pass<float>& pass = session.pipeline->passes().back();
  for (const HeadParts<float>& head : pass.parts().heads) {
    const View<const float> axes = pass.axes(head.channel);
    all.emplace_back(axes.data, axes.data + axes.size());
  }
  return all;
}

bool settle_axes(Session& session) {
  bool any = false;
  const Pass<float>& pass = session.pipeline->passes().back();
  for (const HeadParts<float>& head : pass.parts().heads) {
    const View<float> axes = pass.axes(head.channel);
    const std::vector<FrameChannel*> maps = maps_of(session, head.channel);
    if (axes.empty() || maps.empty()) continue;
    const std::vector<float> found = principal_axes({maps.begin(), maps.end()}, axes.cols);
    std::copy(found.begin(), found.end(), axes.data);
    parallel_for(std::ssize(maps), [&](std::int64_t i) { multiply_rows(*maps[static_cast<std::size_t>(i)], axes); });
    any = true;
  }
  return any;
}

void follow_axes(Session& session, const std::vector<std::vector<float>>& before) {
  const Pass<float>& pass = session.pipeline->passes().back();
  for (std::size_t h = 0; h < before.size(); ++h) {
    const HeadParts<float>& head = pass.parts().heads[h];
    const View<const float> now = pass.axes(head.channel);
    if (now.empty() || std::equal(before[h].begin(), before[h].end(), now.data)) continue;
    // A row y = A^T f on the old axes is f = A y within their span, so A'^T A y on the new ones.
    const Eigen::Map<const Floats> old_axes(before[h].data(), now.rows, now.cols),
        new_axes(now.data, now.rows, now.cols);
    const Floats turn = old_axes.transpose() * new_axes;
    for (FrameChannel* map : maps_of(session, head.channel))
      multiply_rows(*map, View<const float>(turn.data(), now.cols, now.cols));
  }
}

void require_class_table(const std::string& trained, const ClassTable& now, const std::optional<Annotations>& clicks) {
  const std::map<std::int64_t, std::string> before = classes_by_id(trained),
                                            after = classes_by_id(now.empty() ? std::string() : now.to_yaml());
  std::map<std::int64_t, std::string> all = before;
  all.insert(after.begin(), after.end());
  for (const auto& [id, name] : all) {
    const auto then = before.find(id), today = after.find(id);
    if (then != before.end() && today != after.end() && then->second == today->second) continue;
    const int index = now.index_of(static_cast<std::int32_t>(id));
    const bool was_valid = then != before.end() && !then->second.ends_with(kIgnored);
    if (clicks && was_valid && index >= clicks->own_classes() && index < clicks->named_classes()) continue;
    const bool lost = clicks && was_valid && (index >= clicks->named_classes() || today == after.end());
    const auto said = [](const auto& found, const auto& end) {
      return found == end ? "not in the table" : found->second;
    };
    throw Error(
        ErrorKind::data, "checkpoint.classes.changed",
        fmt::format("the scene's class table is not the one that the run was trained with: class {} was {}, and "
                    "is {} now",
                    id, said(then, before.end()), said(today, after.end())),
        lost ? "give the file of clicks that named it: --set scene.labels.clicks=FILE"
             : "restore the table (the run folder's classes.yaml is that of training), or train again with --out");
  }
}

}  // namespace semfield
