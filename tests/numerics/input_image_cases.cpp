// G01 to G05: images, and frames made of them.
#include <cstring>
#include <numeric>

#include "eval/metrics.h"
#include "formats/image_io.h"
#include "formats/png_codec.h"
#include "input_parts.h"
#include "loading/frame_source.h"
#include "testkit/loss_rays.h"
#include "tests/scene/exr_bytes.h"
#include "tests/scene/png_bytes.h"
#include "tests/scene/room_files.h"

namespace semfield::numerics {

namespace {

using namespace testing_room;

void put_bytes(const std::string& path, const std::vector<std::uint8_t>& bytes) {
  plain_write(path, {bytes.begin(), bytes.end()});
}

constexpr const char* kEye = "\"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]";

}  // namespace

void lying_images(CaseRun& run) {
  run.row("-");
  const std::string path = run.folder() + "/lie.png";
  const std::vector<std::uint8_t> body(10, 7);
  if (images_available()) {  // the library of the other formats is loaded when it is first needed
    plain_write(run.folder() + "/small.exr", exr_of(2, 2, {1, 2, 3, 4}));
    run.expect(read_float(run.folder() + "/small.exr").pixels.size() == 4, "a sound image is read");
  }
  const ResourceUse use;
  const struct {
    std::uint32_t width, height;
    const char *words, *words_16;  // with 8 and with 16 bits a value
  } kSizes[] = {{65535, 65535, "65535 pixels along an axis; at most 16384 are read", "at most 16384 are read"},
                {4294967295U, 4294967295U, "", ""},
                {2147483648U, 1, "", ""},
                {16384, 16385, "16384", "16384"},
                {16384, 16384, "cannot hold", "1610612736 bytes once decoded; at most 1073741824 are read"},
                {13000, 13000, "cannot hold", "cannot hold"}};
  for (const auto& size : kSizes) {
    for (const std::uint8_t bits : {std::uint8_t{8}, std::uint8_t{16}}) {
      for (const std::uint8_t interlace : {std::uint8_t{0}, std::uint8_t{1}}) {
        put_bytes(path, png_of(size.width, size.height, bits, 2, interlace, body));
        run.expect_error(ErrorKind::data, {path, bits == 8 ? size.words : size.words_16},
                         [&] { (void)read_rgb(path); });
        run.expect_error(ErrorKind::data, {path}, [&] { (void)read_ids(path); });
      }
    }
  }
  if (images_available()) {
    const std::string exr = run.folder() + "/lie.exr";
    plain_write(exr, exr_of(2, 2, {1, 2, 3, 4}, 65535));
    run.expect_error(ErrorKind::data, {exr}, [&] { (void)read_float(exr); });
    // A bitmap whose header states 65,535 x 65,535 pixels of 24 bits.
    std::string bmp = "BM";
    const auto put = [&](auto value) { bmp.append(reinterpret_cast<const char*>(&value), sizeof value); };
    for (const std::uint32_t word : {64U, 0U, 54U, 40U, 65535U, 65535U}) put(word);
    put(std::uint16_t{1});
    put(std::uint16_t{24});
    for (int i = 0; i < 6; ++i) put(std::uint32_t{0});
    bmp.append(10, '\7');
    plain_write(run.folder() + "/lie.bmp", bmp);
    run.expect_error(ErrorKind::data, {"lie.bmp"}, [&] { (void)read_rgb(run.folder() + "/lie.bmp"); });
  }
  run.measure(use.grown_mib(), 64, "memory, MiB");
  run.note("memory grew by " + std::to_string(static_cast<int>(use.grown_mib())) + " MiB over all");
}

void odd_images(CaseRun& run) {
  run.row("-");
  const std::string path = run.folder() + "/odd.png";
  const auto ids = [&](const std::vector<std::uint8_t>& file) {
    put_bytes(path, file);
    return read_ids(path);
  };
  for (const auto& [w, h] : {std::pair{0U, 0U}, {0U, 7U}, {7U, 0U}}) {
    put_bytes(path, png_of(w, h, 8, 0, 0, {0}));
    run.expect_error(ErrorKind::data, {path, "image has no pixels"}, [&] { (void)read_ids(path); });
  }
  run.expect(ids(png_of(1, 1, 8, 0, 0, {0, 200})).pixels == std::vector<std::uint16_t>{200}, "one pixel");
  run.expect(ids(png_of(2, 1, 16, 0, 0, {0, 1, 2, 255, 255})).pixels == std::vector<std::uint16_t>{258, 65535},
             "16 bits keep their values");
  run.expect(ids(png_of(5, 1, 2, 0, 0, {0, 0x1B, 0xC0})).pixels == std::vector<std::uint16_t>{0, 1, 2, 3, 3}, "2 bits");
  run.expect(
      ids(png_of(9, 1, 1, 0, 0, {0, 0xA5, 0x80})).pixels == std::vector<std::uint16_t>{1, 0, 1, 0, 0, 1, 0, 1, 1},
      "1 bit");
  run.expect(ids(png_of(3, 1, 4, 0, 0, {0, 0x1F, 0x70})).pixels == std::vector<std::uint16_t>{1, 15, 7}, "4 bits");
  // Adam7 of 4 x 4 pixels 0..15: passes 1, 4, 5, 6 and 7 have some.
  std::vector<std::uint16_t> counting(16);
  std::iota(counting.begin(), counting.end(), std::uint16_t{0});
  run.expect(
      ids(png_of(4, 4, 8, 0, 1, {0, 0, 0, 2, 0, 8, 10, 0, 1, 3, 0, 9, 11, 0, 4, 5, 6, 7, 0, 12, 13, 14, 15})).pixels ==
          counting,
      "interlaced");
  run.expect(ids(png_of(1, 1, 8, 0, 1, {0, 9})).pixels == std::vector<std::uint16_t>{9}, "one interlaced pixel");
  const std::vector<std::uint8_t> index{3, 0, 1, 2}, palette{1, 2, 3, 4, 5, 6, 7, 8, 9, 250, 251, 252};
  write_png_palette(path, 2, 2, index, palette);
  run.expect(read_ids(path).pixels == std::vector<std::uint16_t>({3, 0, 1, 2}), "a palette's ids are its indices");
  run.expect(read_rgb(path).pixels == std::vector<std::uint8_t>({250, 251, 252, 1, 2, 3, 4, 5, 6, 7, 8, 9}),
             "its colours are its entries");
  const std::vector<std::uint8_t> beyond{9, 0, 1, 2};
  put_bytes(path, encode_png(2, 2, 3, 8, beyond, {palette}));
  run.expect_error(ErrorKind::data, {path}, [&] { (void)read_rgb(path); });
  for (const std::uint8_t bits : {std::uint8_t{0}, std::uint8_t{3}, std::uint8_t{32}}) {
    put_bytes(path, png_of(1, 1, bits, 0, 0, {0, 0, 0, 0, 0}));
    run.expect_error(ErrorKind::data, {path}, [&] { (void)read_ids(path); });
  }
  const std::vector<std::uint8_t> whole = encode_png_rgb(8, 8, std::vector<std::uint8_t>(192, 60));
  int cuts = 0;
  for (std::size_t size = 0; size < whole.size(); ++size, ++cuts) {
    const std::span<const std::uint8_t> part(whole.data(), size);
    run.expect_error(ErrorKind::data, {}, [&] { (void)decode_png(std::as_bytes(part)); });
  }
  run.note(std::to_string(cuts) + " lengths of one file, all refused");
}

void frame_files_at_odds(CaseRun& run) {
  run.row("-");
  const std::string root = run.folder();
  testing_room::write_replica(root, 4, 8, 6);
  std::filesystem::remove(root + "/rgb/rgb_0.png");
  std::filesystem::remove(root + "/depth/depth_1.png");
  write_png_gray8(root + "/semantic_class/semantic_class_2.png", 4, 3, std::vector<std::uint8_t>(12, 1));
  write_png_gray16(root + "/depth/depth_3.png", 6, 8, std::vector<std::uint16_t>(48, 1000));
  Diagnostics found;
  const auto data = dataset_of(run, "replica", {{"root", root}, {"train_step", "1"}, {"test_step", "0"}});
  (void)load_scene(*data, {}, found);
  run.expect(found.error_count() == 4, "every problem of every frame in one pass");
  for (const char* words :
       {"'rgb_0'", "rgb/rgb_0.png' is missing", "depth/depth_1.png' is missing",
        "semantic_class_2.png' is 4 x 3 pixels, the camera 8 x 6", "depth_3.png' is 6 x 8 pixels, the camera 8 x 6"})
    run.expect(told(found, Severity::error, words), words);
  // The same frame twice, in either kind of index.
  testing_room::write_replica(root, 2, 8, 6);
  std::filesystem::copy_file(root + "/semantic_class/semantic_class_1.png", root + "/semantic_class/0001.png");
  Diagnostics twice;
  (void)dataset_of(run, "replica", {{"root", root}, {"train_step", "1"}, {"test_step", "0"}})->open(twice);
  run.expect(told(twice, Severity::error, "are labels of the same frame"), "two label images of one frame");
  write_png_rgb(root + "/a.png", 4, 4, std::vector<std::uint8_t>(48));
  const std::string frame = "{\"file_path\": \"a.png\", " + std::string(kEye) + "}";
  plain_write(root + "/transforms.json", "{\"fl_x\": 4, \"frames\": [" + frame + ", " + frame + "]}");
  Diagnostics listed;
  (void)dataset_of(run, "transforms_json", {{"root", root}})->open(listed);
  run.expect(told(listed, Severity::error, "frame 1 (a.png): image is listed twice"), "an image listed twice");
}

void float_depth(CaseRun& run) {
  run.row("fp32");
  if (!images_available()) return run.absent("this build reads PNG alone");
  const std::string root = run.folder();
  const float inf = std::numeric_limits<float>::infinity(), nan = std::numeric_limits<float>::quiet_NaN();
  const std::vector<float> written{1.5F, nan, inf, -inf, -2, 0, -0.0F, 1e-30F, 3.25F, -nan, 1e30F, 0.1F};
  const std::vector<float> wanted{1.5F, 0, 0, 0, 0, 0, 0, 1e-30F, 3.25F, 0, 1e30F, 0.1F};
  plain_write(root + "/d.exr", exr_of(4, 3, written));
  write_png_rgb(root + "/a.png", 4, 3, std::vector<std::uint8_t>(36, 9));
  plain_write(
      root + "/transforms.json",
      "{\"fl_x\": 4, \"frames\": [{\"file_path\": \"a.png\", \"depth_path\": \"d.exr\", " + std::string(kEye) + "}]}");
  const auto data = dataset_of(run, "transforms_json", {{"root", root}});
  Diagnostics found;
  const SceneInfo info = data->open(found);
  run.expect(!found.has_errors() && info.frames.size() == 1, "the frame is read");
  FrameBuffer frame;
  data->read(0, frame);
  run.expect(frame.depth_m.size() == wanted.size(), "all pixels");
  for (std::size_t i = 0; i < wanted.size() && i < frame.depth_m.size(); ++i)
    run.measure(std::abs(static_cast<double>(frame.depth_m[i]) - static_cast<double>(wanted[i])), 0, "depth");
  run.note("NaN, infinite and negative depth reads as none");
  plain_write(root + "/d.exr", exr_of(4, 3, written).substr(0, 340));
  run.expect_error(ErrorKind::data, {"d.exr"}, [&] { data->read(0, frame); });
}

void special_depth(CaseRun& run) {
  run.row("fp32");
  const std::string root = run.folder();
  testing_room::write_replica(root, 2, 16, 12);
  const auto load = [&] {
    Diagnostics found;
    const auto data = dataset_of(run, "replica", {{"root", root}, {"train_step", "1"}, {"test_step", "0"}});
    LoadedScene scene = load_scene(*data, {}, found);
    found.throw_if_errors(ErrorKind::data, "");
    return scene;
  };
  const FrameBuffer truth = testing_room::render_room(testing_room::room_camera(16, 12), testing_room::room_pose(0));
  std::vector<std::uint16_t> mm = testing_room::mm_of(truth);
  std::vector<float> wanted;
  for (std::size_t i = 0; i < mm.size(); ++i) {
    if (i % 3 == 1) mm[i] = 0;
    wanted.push_back(mm[i] == 0 ? 0.0F : static_cast<float>(mm[i] * 0.001));
  }
  write_png_gray16(root + "/depth/depth_0.png", 16, 12, mm);
  const LoadedScene masked = load();
  for (std::size_t i = 1; i < mm.size(); i += 3) mm[i] = 65535;
  write_png_gray16(root + "/depth/depth_0.png", 16, 12, mm);
  const LoadedScene special = load();
  run.expect(masked.frames[0].depth_m == special.frames[0].depth_m, "65535 reads as 0 does: no depth");
  for (std::size_t i = 0; i < wanted.size(); ++i)
    run.measure(std::abs(special.frames[0].depth_m[i] - wanted[i]), 0, "depth of the others");
  for (int a = 0; a < 3; ++a) {
    run.measure(std::abs(masked.bounds.lo[a] - special.bounds.lo[a]), 0, "bounds");
    run.measure(std::abs(masked.bounds.hi[a] - special.bounds.hi[a]), 0, "bounds");
  }
  run.measure(std::abs(masked.far_m - special.far_m) + std::abs(masked.near_m - special.near_m), 0, "distances");
  // In the metrics: NaN, infinite, negative and zero truth is no truth.
  std::vector<float> predicted(wanted.size(), 2.0F), spoiled = wanted;
  const float bad[] = {0, std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity(), -1, -0.0F};
  for (std::size_t i = 1; i < spoiled.size(); i += 3) spoiled[i] = bad[i % 5];
  DepthError clean(10), marked(10);
  clean.add(wanted, predicted);
  marked.add(spoiled, predicted);
  run.expect(clean.scored_px() > 0 && clean.scored_px() == marked.scored_px(), "the same pixels are scored");
  run.measure(std::abs(*clean.rmse() - *marked.rmse()) + std::abs(*clean.abs_rel() - *marked.abs_rel()), 0, "metrics");
  // In the losses: a pixel of such depth counts for nothing and moves nothing.
  for (const PluginEntry* entry : run.registry().entries()) {
    if (entry->kind != PluginKind::loss) continue;
    const std::unique_ptr<Loss> term = entry->loss(*entry->new_params());
    if (!term->traits().reads_target(channel::depth)) continue;
    testkit::LossRays<float> sound({4, 4, 4, 4, 4}), spoilt = sound;
    sound.depth_target = {0, 0, 0, 0, 2};
    spoilt.depth_target = {0, -0.0F, std::numeric_limits<float>::quiet_NaN(), -1, 2};
    const std::string& name = entry->name;
    run.expect(term->counted_rays(spoilt.targets(), 5) == 1, name + " counts one pixel");
    run.measure(std::abs(spoilt.add(*term, 1) - sound.add(*term, 1)), 0, name);
    run.expect(spoilt.d_depth == sound.d_depth && spoilt.d_weight == sound.d_weight, name + " has the same gradients");
    run.measure(std::abs(spoilt.d_depth[2]), 0, name + ", gradient of a pixel without depth");
  }
}

}  // namespace semfield::numerics
