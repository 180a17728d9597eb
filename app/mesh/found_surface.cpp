#include "app/mesh/found_surface.h"

#include <algorithm>

#include "app/progress_line.h"
#include "core/usual_metre.h"

namespace semfield::app {

namespace {

// The mesh's, and that of the fused depth images, which is the mesh itself where it was made of them.
MeshScores scores_of(const MeshOptions& options, const RunSurface& found, const Session& s,
                     const MeasuredDepth& measured) {
  const double metre = usual_metre(s.scene.info.metric, s.extent.bounds.size());
  const DepthReference reference(measured.training, measured.held_out, metre);
  MeshScores scores{metre, reference.points(), reference.held_out_points(), reference.score(found.surface), {}};
  if (found.source == "sensor" || measured.training.empty()) return scores;
  Surface of_sensor = fused_surface(measured.training, s.limits, found.grid);
  drop_small_components(of_sensor, options.keep_components);
  scores.sensor = reference.score(of_sensor);
  return scores;
}

}  // namespace

double spacing_of(const MeshOptions& options, const Box& bounds, long long cells) {
  const Vec3d size = bounds.size();
  return options.voxel.value_or(std::max({size.x, size.y, size.z}) /
                                static_cast<double>(options.resolution.value_or(cells)));
}

FoundSurface find_surface(const MeshOptions& options, OpenedRun& run, const AppContext& context) {
  const Session& s = run.session;
  const bool of_sensor = surface_source(options, s) == "sensor";
  MeasuredDepth measured;
  if (options.score || of_sensor) measured = measured_depth(run.session, options.run, of_sensor);
  ProgressLine progress(context, "depth of", "views");
  FoundSurface found{make_run_surface(s, options.run, options, measured.training,
                                      {[&](const std::string& note) { print_note(context, note); },
                                       [&](double done, double of) { progress.show(done, of); }}),
                     {}};
  if (options.score) found.scores = scores_of(options, found, s, measured);
  return found;
}

}  // namespace semfield::app
