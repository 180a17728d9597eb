// Packs the analytic room for tests in Python (program.py): analytic_room FILE [without_depth].
#include "loading/packed_scene.h"
#include "testkit/analytic_scene.h"

int main(int argc, char** argv) {
  using namespace semfield;
  if (argc < 2) return 2;
  const std::unique_ptr<Dataset> scene = testkit::make_analytic_scene();
  Diagnostics diagnostics;
  const SceneInfo info = scene->open(diagnostics);
  PackOptions options;
  options.with_depth = argc < 3;
  write_packed_scene(argv[1], info, [&](int frame, FrameBuffer& out) { scene->read(frame, out); }, options);
}
