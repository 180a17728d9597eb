#include "studies/leave_out_pairs.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

#include "report/sweep/sweep_results.h"
#include "studies/leave_out_side.h"
#include "studies/step_bench.h"
#include "system/checksum.h"

namespace semfield {

namespace {

// One test frame, pass by pass, as the pipeline renders it; keeps what no picture shows: logits of rays and samples.
struct Picture {
  std::vector<float> color, depth, opacity, logits;  // [R, 3], [R, 1], [R, 1], [R, C]
  std::int64_t evaluated = 0;                        // samples
  double largest_logit = 0;                          // of a sample that was evaluated, without its weight
};

Picture picture_of(const LeaveOutSide& side, const FrameInfo& info) {
  constexpr std::int64_t kRays = 256;
  const RayCamera camera{info.camera, info.world_from_camera, side.session.plan.undistortion};
  const std::int64_t pixels = std::int64_t{info.camera.width_px} * info.camera.height_px;
  Picture out;
  Workspace arena;
  std::vector<double> origin(3 * kRays), direction(3 * kRays), near_far(2 * kRays);
  for (std::int64_t begin = 0; begin < pixels; begin += kRays) {
    const std::int64_t count = std::min(kRays, pixels - begin);
    for (std::int64_t i = 0; i < count; ++i) {
      cast_ray(camera, side.session.limits, static_cast<std::int32_t>((begin + i) % info.camera.width_px),
               static_cast<std::int32_t>((begin + i) / info.camera.width_px), &origin[static_cast<std::size_t>(3 * i)],
               &direction[static_cast<std::size_t>(3 * i)], &near_far[static_cast<std::size_t>(2 * i)]);
    }
    const Workspace::Scope scope(arena);
    const Rays<float> rays{{origin.data(), count, 3}, {direction.data(), count, 3}, {near_far.data(), count, 2}};
    StepContext ctx;
    ctx.seed = side.pipeline().options().seed;
    ctx.training = false;
    ctx.workspace = &arena;
    const std::vector<Pass<float>>& passes = side.pipeline().passes();
    PassTrace<float> trace;
    Proposal<float> proposal;
    std::int64_t per_ray = 0;
    for (std::size_t p = 0; p < passes.size(); ++p) {
      ctx.pass = passes[p].parts().number;
      const PassTrace<float> next =
          passes[p].forward(ctx, 0, rays, p == 0 ? nullptr : &proposal, per_ray, {p + 1 == passes.size() ? count : 0});
      trace = next;
      per_ray = passes[p].capacity_per_ray(per_ray);
      proposal.samples = &trace.samples;
      proposal.weight = trace.weight.row_range(0, trace.samples.count);
    }
    const auto take = [](std::vector<float>& to, View<const float> from) {
      for (std::int64_t r = 0; r < from.rows; ++r) to.insert(to.end(), from.row(r), from.row(r) + from.cols);
    };
    take(out.color, trace.color);
    take(out.depth, trace.depth);
    take(out.opacity, trace.opacity);
    // A colour is in (0, 1): the zeros of samples that were passed over tell them apart.
    for (std::int64_t m = 0; m < trace.samples.count; ++m) out.evaluated += trace.out.rgb(m, 0) != 0 ? 1 : 0;
    if (trace.semantic.rows.empty()) continue;
    take(out.logits, trace.semantic.rows);
    const Head<float>& head = *passes.back().parts().head;
    const View<float> each = arena.take<float>(trace.semantic_samples, head.width());
    const Tensor<float>& weight = *side.pipeline().store().find(passes.back().parts().name + "/semantic/class/weight");
    const Tensor<float>& bias = *side.pipeline().store().find(passes.back().parts().name + "/semantic/class/bias");
    for (std::int64_t m = 0; m < each.rows; ++m) {
      for (std::int32_t c = 0; c < each.cols; ++c) {
        double s = static_cast<double>(bias.value.data()[c]);
        for (std::int32_t h = 0; h < trace.semantic.hidden.cols; ++h)
          s += static_cast<double>(trace.semantic.hidden(m, h)) *
               static_cast<double>(weight.value.data()[h * each.cols + c]);
        out.largest_logit = std::max(out.largest_logit, std::abs(s));
      }
    }
  }
  return out;
}

double largest_difference(const std::vector<float>& a, const std::vector<float>& b) {
  if (a.size() != b.size()) return INFINITY;
  double most = 0;
  for (std::size_t i = 0; i < a.size(); ++i) {
    const double d = std::abs(static_cast<double>(a[i]) - static_cast<double>(b[i]));
    most = std::max(most, std::isnan(d) ? INFINITY : d);
  }
  return most;
}

std::string hash_of(const std::vector<const std::vector<float>*>& maps) {
  Sha256 sum;
  for (const std::vector<float>* map : maps) sum.add(std::as_bytes(std::span(*map)));
  return sum.hex();
}

PairResult compare_training(const PairOptions& options, LeaveOutSide& out, LeaveOutSide& kept, bool only_cost) {
  PairResult result;
  result.cost = measure_sides(
      "step", options.rounds, options.steps_a_round, [&] { out.train(options.steps_a_round); },
      [&] { kept.train(options.steps_a_round); });
  int shared = 0;
  const std::string a = hash_of_shared(out.pipeline(), kept.pipeline(), shared);
  const std::string b = hash_of_shared(kept.pipeline(), out.pipeline(), shared);
  if (only_cost) {
    // What is to be paid for must be there: settings that change nothing would be measured as free.
    result.holds = a != b || shared == 0;
    if (!result.holds) result.result = "both sides are the same training, so nothing was measured";
    return result;
  }
  result.holds = a == b && shared > 0;
  result.result =
      hashes_text(a, b, fmt::format("{} tensors and their moments after {} steps", shared, out.trainer->step()));
  return result;
}

PairResult compare_pictures(const LeaveOutPair& pair, const PairOptions& options, const LeaveOutSide& out,
                            const LeaveOutSide& kept) {
  copy_tensors(out.pipeline(), kept.pipeline());
  const std::vector<int> frames = evenly_spaced(out.session.scene.frames_of(Split::test), options.frames);
  double color = 0, logits = 0, largest = 0;
  std::int64_t samples_out = 0, samples_kept = 0;
  Sha256 hash_out, hash_kept;
  for (const int f : frames) {
    const FrameInfo& info = out.session.scene.info.frames[static_cast<std::size_t>(f)];
    const Picture a = picture_of(out, info), b = picture_of(kept, info);
    color = std::max(color, largest_difference(a.color, b.color));
    logits = std::max(logits, largest_difference(a.logits, b.logits));
    largest = std::max({largest, a.largest_logit, b.largest_logit});
    samples_out += a.evaluated;
    samples_kept += b.evaluated;
    for (const auto map : {&Picture::color, &Picture::depth, &Picture::opacity, &Picture::logits}) {
      hash_out.add(std::as_bytes(std::span(a.*map)));
      hash_kept.add(std::as_bytes(std::span(b.*map)));
    }
  }
  PairResult result;
  const FrameInfo& info = out.session.scene.info.frames[static_cast<std::size_t>(frames.at(0))];
  const auto draw = [&](const LeaveOutSide& side) {
    render_frame(side.pipeline(), {info.camera, info.world_from_camera, side.session.plan.undistortion},
                 side.session.limits, side.session.plan.class_of_logit);
  };
  result.cost = measure_sides(
      "picture", options.rounds, 1, [&] { draw(out); }, [&] { draw(kept); });
  result.idle = samples_out >= samples_kept;
  const std::string counts =
      result.idle ? "; nothing was left out" : fmt::format("; {} of {} samples evaluated", samples_out, samples_kept);
  if (pair.proof == ProofClass::bitwise) {
    const std::string a = hash_out.hex(), b = hash_kept.hex();
    result.holds = a == b;
    result.result =
        hashes_text(a, b, fmt::format("colour, depth, opacity and logits of {} pictures", frames.size())) + counts;
    return result;
  }
  // What a ray may lose: the transmittance at which it stops, or the sampler's budget of optical depth. Removing that
  // much moves a colour in [0, 1] by at most as much, and a logit by that times the range of a sample's logits. The
  // rest is rounding of fp32 sums.
  const double share = pair.bound;
  const double rounding = 2e-6;
  const double color_bound = share + rounding, logit_bound = (2 * share + rounding) * largest;
  result.holds = color <= color_bound && logits <= logit_bound;
  result.result = fmt::format(
                      "colour: bound {:.2g}, difference {:.2g}; logits (a sample's reach {:.1f}): bound {:.2g}, "
                      "difference {:.2g}",
                      color_bound, color, largest, logit_bound, logits) +
                  counts;
  return result;
}

PairResult compare_outputs(const PairOptions& options, const LeaveOutSide& side) {
  const std::vector<int> frames = evenly_spaced(side.session.scene.frames_of(Split::test), 1);
  const FrameInfo& info = side.session.scene.info.frames[static_cast<std::size_t>(frames.at(0))];
  const RayCamera camera{info.camera, info.world_from_camera, side.session.plan.undistortion};
  const std::int64_t rays = std::int64_t{info.camera.width_px} * info.camera.height_px;
  const auto size = static_cast<std::size_t>(rays);
  std::vector<double> origin(3 * size), direction(3 * size), near_far(2 * size);
  for (std::int64_t i = 0; i < rays; ++i) {
    cast_ray(camera, side.session.limits, static_cast<std::int32_t>(i % info.camera.width_px),
             static_cast<std::int32_t>(i / info.camera.width_px), &origin[static_cast<std::size_t>(3 * i)],
             &direction[static_cast<std::size_t>(3 * i)], &near_far[static_cast<std::size_t>(2 * i)]);
  }
  std::vector<float> color[2], depth[2], entropy(size), confidence(size);
  std::vector<std::int16_t> label(size);
  const auto draw = [&](std::size_t which, bool all) {
    color[which].resize(3 * size);
    depth[which].resize(size);
    RenderJob<float> job;
    job.origin = {origin.data(), rays, 3};
    job.direction = {direction.data(), rays, 3};
    job.near_far = {near_far.data(), rays, 2};
    job.color = {color[which].data(), rays, 3};
    job.depth = {depth[which].data(), rays, 1};
    if (all) {
      job.label = {label.data(), rays, 1};
      job.entropy = {entropy.data(), rays, 1};
      job.confidence = {confidence.data(), rays, 1};
    }
    side.pipeline().render(job);
  };
  PairResult result;
  result.cost = measure_sides(
      "picture", options.rounds, 1, [&] { draw(0, false); }, [&] { draw(1, true); });
  const std::string a = hash_of({&color[0], &depth[0]}), b = hash_of({&color[1], &depth[1]});
  result.holds = a == b;
  result.result = hashes_text(a, b, "colour and depth of a test frame");
  return result;
}

std::string interval_text(const MeanInterval& m, double factor, const char* unit) {
  return fmt::format("{:+.2f} [{:+.2f}, {:+.2f}] {}", factor * m.mean, factor * (m.mean - m.half_width),
                     factor * (m.mean + m.half_width), unit);
}

using Configs = std::function<std::string(const std::string&)>;

PairResult compare_quality(const LeaveOutPair& pair, const PairOptions& options, Registry& registry,
                           const std::string& config) {
  PairResult result;
  std::vector<double> share, psnr_db, miou;
  for (int seed = 1; seed <= options.seeds; ++seed) {
    LeaveOutSide out(pair, pair.out, options, registry, config, seed);
    LeaveOutSide kept(pair, pair.kept, options, registry, config, seed);
    // In pieces that alternate: what disturbs the machine meets both.
    const int rounds = std::max(1, options.seed_steps / 20);
    const PairCost cost = measure_sides(
        "step", rounds, options.seed_steps / rounds, [&] { out.train(options.seed_steps / rounds); },
        [&] { kept.train(options.seed_steps / rounds); });
    if (seed == 1) result.cost = cost;
    share.push_back(cost.share);
    result.cost.out_bytes = out.bytes();
    result.cost.kept_bytes = kept.bytes();
    const SplitScore a = out.score(1 << 30), b = kept.score(1 << 30);
    psnr_db.push_back(a.color.psnr_db().value() - b.color.psnr_db().value());
    if (a.confusion.miou_present() && b.confusion.miou_present())
      miou.push_back(*a.confusion.miou_present() - *b.confusion.miou_present());
  }
  std::sort(share.begin(), share.end());
  result.cost.share = spread_of(share).median;
  result.cost.noise = 0.5 * (share[share.size() * 3 / 4] - share[share.size() / 4]);
  const MeanInterval psnr = mean_interval(psnr_db), classes = mean_interval(miou);
  result.holds = psnr.n >= 2 && psnr.mean - psnr.half_width >= kPsnrMargin_dB &&
                 (classes.n == 0 || classes.mean - classes.half_width >= kMiouMargin);
  result.result =
      fmt::format("{} seeds, {} steps: PSNR {}", options.seeds, options.seed_steps, interval_text(psnr, 1, "dB"));
  if (classes.n > 0) result.result += ", mIoU " + interval_text(classes, 100, "points");
  result.idle = std::all_of(psnr_db.begin(), psnr_db.end(), [](double d) { return d == 0; });
  if (result.idle) result.result += "; nothing was left out";
  return result;
}

PairResult compare_once(const LeaveOutPair& pair, const PairOptions& options, Registry& registry,
                        const std::string& config) {
  LeaveOutSide out(pair, pair.out, options, registry, config, 1), kept(pair, pair.kept, options, registry, config, 1);
  out.train(1);  // outside the timing: memory grows in it
  PairResult result;
  switch (pair.kind) {
    case PairKind::training:
    case PairKind::cost:
      kept.train(1);
      result = compare_training(options, out, kept, pair.kind == PairKind::cost);
      break;
    case PairKind::rendering:
      out.train(pair.steps);
      result = compare_pictures(pair, options, out, kept);
      break;
    case PairKind::outputs:
      out.train(pair.steps);
      result = compare_outputs(options, out);
      break;
    case PairKind::rows:
      out.train(pair.steps);
      result = compare_rows(options, out, kept);
      break;
    case PairKind::evaluation:
      kept.train(1);
      result = compare_evaluation(options, out, kept);
      break;
    case PairKind::checks:
      result = cost_of_checks(options, out);
      break;
    case PairKind::library:
      return cost_of_image_library();
    case PairKind::quality:
      break;  // not here
  }
  result.cost.out_bytes = out.bytes();
  result.cost.kept_bytes = kept.bytes();
  return result;
}

}  // namespace

PairResult run_pair(const LeaveOutPair& pair, const PairOptions& options, Registry& registry, const Configs& configs) {
  const double begin = processor_s();
  const std::string config = configs(pair.config);
  PairResult result = pair.kind == PairKind::quality ? compare_quality(pair, options, registry, config)
                                                     : compare_once(pair, options, registry, config);
  result.seconds = processor_s() - begin;
  return result;
}

}  // namespace semfield
