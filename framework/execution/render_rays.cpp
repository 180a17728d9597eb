#include "execution/render_rays.h"

#include "core/check.h"
#include "execution/host_ends.h"

namespace semfield {

template <class Real>
RenderJob<Real> RenderJob<Real>::rows(std::int64_t begin, std::int64_t count) const {
  RenderJob part = *this;
  const auto cut = [&](auto&... views) { ((views = views.row_range(begin, count)), ...); };
  cut(part.origin, part.direction, part.near_far, part.truth, part.color, part.depth, part.opacity, part.label,
      part.entropy, part.confidence, part.truth_probability, part.probability, part.resolution);
  part.heads = heads.row_range(begin, count);
  return part;
}

template <class Real>
void render_rays(const std::vector<Pass<Real>>& passes, const std::vector<std::int64_t>& per_ray,
                 const RenderJob<Real>& job, const StepContext& call) {
  StepContext ctx = call;
  const PassParts<Real>& parts = passes.back().parts();
  const Stages<Real>& stages = *parts.stages;
  const HostEnds<Real> ends{stages, *ctx.workspace};
  const Rays<Real> rays{ends.sent(job.origin), ends.sent(job.direction), ends.sent(job.near_far)};
  const bool classes =
      parts.head && !(job.label.empty() && job.entropy.empty() && job.confidence.empty() && job.probability.empty());
  const bool heads = job.heads.size() > 0;
  Proposal<Real> proposal;
  PassTrace<Real> trace;
  for (std::size_t p = 0; p < passes.size(); ++p) {
    ctx.pass = passes[p].parts().number;
    const bool last = p + 1 == passes.size();
    const PassTrace<Real> next =
        passes[p].forward(ctx, kMainGradient, rays, p == 0 ? nullptr : &proposal, p == 0 ? 0 : per_ray[p - 1],
                          {last && classes ? job.origin.rows : 0, last, last && heads});
    trace = next;
    proposal.samples = &trace.samples;
    proposal.weight = trace.weight.row_range(0, trace.samples.count);
  }
  ends.fetch(trace.color, job.color);
  ends.fetch(trace.depth, job.depth);
  ends.fetch(trace.opacity, job.opacity);
  for (const auto& channel : job.heads) {
    const View<const Real> rows = passes.back().values_of({}, trace).heads[channel.name];
    SEMFIELD_CHECK(rows.cols == channel.view.cols, "a channel of the pass, with its columns");
    ends.fetch(rows, channel.view);
  }
  if (!job.resolution.empty()) {
    const View<OpacityResolution> found = ends.room_for(job.resolution);
    stages.opacity_resolutions(trace.samples, trace.weight, passes.back().rules().rendering.far, job.footprint_per_m,
                               found);
    ends.fetch(found, job.resolution);
  }
  if (!classes) return;
  SEMFIELD_CHECK(job.probability.empty() || job.probability.cols == trace.semantic.rows.cols,
                 "probabilities of rays have a column a logit");
  ClassResults<Real> results;
  results.truth = ends.sent(job.truth);
  results.label = ends.room_for(job.label);
  results.entropy = ends.room_for(job.entropy);
  results.confidence = ends.room_for(job.confidence);
  results.truth_probability = ends.room_for(job.truth_probability);
  results.probability = ends.room_for(job.probability);
  stages.class_results(trace.semantic.rows, results);
  ends.fetch(results.label, job.label);
  ends.fetch(results.entropy, job.entropy);
  ends.fetch(results.confidence, job.confidence);
  ends.fetch(results.truth_probability, job.truth_probability);
  ends.fetch(results.probability, job.probability);
}

template <class Real>
void query_density(const Pass<Real>& pass, View<const double> positions, View<Real> sigma, const StepContext& call) {
  StepContext ctx = call;
  ctx.pass = pass.parts().number;
  const HostEnds<Real> ends{*pass.parts().stages, *ctx.workspace};
  const View<Real> found = ends.room_for(sigma);
  pass.density(ctx, ends.sent(positions), found);
  ends.fetch(found, sigma);
}

#define SEMFIELD_INSTANTIATE(Real)                                                                  \
  template struct RenderJob<Real>;                                                                  \
  template void render_rays<Real>(const std::vector<Pass<Real>>&, const std::vector<std::int64_t>&, \
                                  const RenderJob<Real>&, const StepContext&);                      \
  template void query_density<Real>(const Pass<Real>&, View<const double>, View<Real>, const StepContext&);
SEMFIELD_INSTANTIATE(float)
SEMFIELD_INSTANTIATE(double)
#undef SEMFIELD_INSTANTIATE

}  // namespace semfield
