#include <fmt/format.h>

#include "compute/parallel.h"
#include "core/text.h"
#include "session/session.h"
#include "session/settings/run_length.h"

namespace semfield {

std::string describe_session(const Session& s) {
  const WorkSettings work = s.work();
  const WorkScope scope(work);
  std::string out;
  const auto add = [&](const std::string& line) { out += line + "\n"; };
  const std::vector<int> train = s.scene.frames_of(Split::train), test = s.scene.frames_of(Split::test);
  const FrameInfo& first = s.scene.info.frames.at(static_cast<std::size_t>(train.empty() ? 0 : train.front()));
  const Vec3d size = s.extent.bounds.size();
  add(fmt::format("scene     {}: {} training and {} test frames at {}x{}, {} classes, labels on {} training frames",
                  s.scene.info.name, train.size(), test.size(), first.camera.width_px, first.camera.height_px,
                  s.classes(), s.manifest.labelled_frames));
  if (s.config.labels.from.reader) add("labels    from " + s.config.labels.from.type);
  for (const TrainingLabels::Step& step : s.labels.steps) {
    std::vector<std::string> facts;
    for (const auto& [name, value] : step.facts) facts.push_back(name + " " + value);
    add("labels    " + step.type + ": " + join(facts));
  }
  add(fmt::format("bounds    {:.3g} x {:.3g} x {:.3g} {} (from {}), near {:.3g}, far {:.3g} (from {})", size.x, size.y,
                  size.z, s.scene.info.metric ? "m" : "units of the poses", s.scene.bounds_from, s.extent.near_m,
                  s.extent.far_m, s.scene.near_far_from));
  if (s.pipeline) {
    for (const Pass<float>& pass : s.pipeline->passes()) {
      std::string slots;
      for (const PassConfig& p : s.config.passes) {
        if (p.name != pass.parts().name) continue;
        slots = p.sampler.entry->name + ", " + p.position.entry->name + " (" +
                std::to_string(pass.parts().position->traits().out_dims) + ")";
        if (pass.parts().direction) slots += ", direction " + p.direction.entry->name;
        slots += ", " + p.field.entry->name;
        if (pass.parts().branch) {
          slots += ", semantics by " + p.branch()->position.entry->name + " (" +
                   std::to_string(pass.parts().branch->position->traits().out_dims) + ") and " +
                   p.branch()->field.entry->name;
        }
      }
      add(fmt::format("pass      {}: {}{}", pass.parts().name, slots,
                      pass.parts().head ? fmt::format(", {} classes", pass.parts().head->width()) : ", no semantics"));
    }
    for (const HeadConfig& head : s.config.heads) {
      add(fmt::format("head      {}: {} columns{}, by {}, {} and {}", head.channel, head.width,
                      head.source_width > 0 ? fmt::format(" (principal axes of {})", head.source_width) : "",
                      head.head.entry->name, head.position.entry->name, head.field.entry->name));
    }
    add(fmt::format("learned   {} parameters; {} of {} rays, tiles of {}, {} lanes, {} threads",
                    s.pipeline->store().learned_count(),
                    (last_step(s.config) > 0 ? "" : "as many steps as fit into ") + length_text(s.config),
                    s.config.train.rays, s.pipeline->tile_rays(), s.config.runtime.lanes, thread_count()));
    out += memory_table(s.memory, allowed_memory(s.config.runtime.memory_gb));
  }
  for (const std::string& line : s.choices()) add("chosen    " + line);
  for (const LeftOut& row : s.plan.left_out) {
    add(fmt::format("left out  {} [{}]: {}; this saves {}", row.component, static_cast<char>(row.proof), row.evidence,
                    row.saving));
  }
  for (const std::string& name : s.plan.kept) add("kept      " + name + " (--keep)");
  return out;
}

}  // namespace semfield
