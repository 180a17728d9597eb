// G01 to G05: images, and frames made of them.

#include <algorithm>
#include <numeric>

#include "config/config_tree.h"
#include "eval/metrics.h"
#include "named_case.h"
#include "rooms.h"
#include "scene/loading/frame_source.h"
#include "testkit/loss_rays.h"
#include "tests/scene/image_bytes.h"
#include "tests/scene/room_files.h"
#include "train/run_folder.h"

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
  const std::vector<std::uint8_t> whole = encode_png(8, 8, 2, 8, std::vector<std::uint8_t>(192, 60));
  int cuts = 0;
  for (std::size_t size = 0; size < whole.size(); ++size, ++cuts) {
    const std::span<const std::uint8_t> part(whole.data(), size);
    run.expect_error(ErrorKind::data, {}, [&] { (void)decode_png(std::as_bytes(part)); });
  }
  run.note(std::to_string(cuts) + " lengths of one file, all refused");
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
    run.near(frame.depth_m[i], wanted[i], 0, "depth");
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
    run.near(special.frames[0].depth_m[i], wanted[i], 0, "depth of the others");
  for (int a = 0; a < 3; ++a) {
    run.near(masked.bounds.lo[a], special.bounds.lo[a], 0, "bounds");
    run.near(masked.bounds.hi[a], special.bounds.hi[a], 0, "bounds");
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
    run.near(spoilt.add(*term, 1), sound.add(*term, 1), 0, name);
    run.expect(spoilt.d_depth == sound.d_depth && spoilt.d_weight == sound.d_weight, name + " has the same gradients");
    run.measure(std::abs(spoilt.d_depth[2]), 0, name + ", gradient of a pixel without depth");
  }
}

// G09 to G11: checkpoints that lie.

namespace {

// A real checkpoint of a small network in three steps: parameters, moments, a resolved configuration.
std::string small_checkpoint(const Registry& known) {
  Registry registry = with_room(known);
  Session session = open_room(
      "scene: {type: box_room}\nrendering: {density_activation: softplus}\npasses:\n"
      "  - sampler: {type: stratified, samples: 4}\n    position: {type: frequency, frequencies: 1}\n"
      "    direction: {type: spherical_harmonics, degree: 1}\n"
      "    field: {type: tiny_mlp, hidden_width: 8, color_width: 8, color_layers: 1}\ntrain: {rays: 16}\n",
      registry);
  Trainer trainer(session);
  for (int step = 0; step < 3; ++step) trainer.advance();
  return encode_safetensors(trainer.tensors(), {{"format", "semfield-checkpoint-1"},
                                                {"config", write_config(resolved_config(session.config))}});
}

bool refused_as_data(const std::string& bytes) {
  try {
    (void)TensorFile::decode(bytes, "checkpoint", {});
  } catch (const Error& error) {
    return error.kind() == ErrorKind::data && !error.remedy().empty();
  }
  return false;
}

std::string with_header(const std::string& header, std::size_t data_bytes) {
  std::string file(8, '\0');
  const std::uint64_t length = header.size();
  std::memcpy(file.data(), &length, 8);
  return file + header + std::string(data_bytes, '\0');
}

void save(CheckpointStore& store, std::int64_t step, std::size_t values = 2000) {
  const std::vector<float> data(values, static_cast<float>(step));
  store.save(step, {tensor_ref("w", {static_cast<std::int64_t>(values)}, data)}, {});
}

}  // namespace

void checkpoint_flips(CaseRun& run) {
  run.row("-");
  const std::string good = small_checkpoint(run.registry());
  (void)TensorFile::decode(good, "checkpoint", {});
  const std::size_t bits = 8 * good.size();
  const int flips = 10'000;
  int accepted = 0;
  for (int i = 0; i < flips; ++i) {
    // Evenly over the file, at a random place of each part: header, metadata and every tensor get their part.
    const auto part = static_cast<std::size_t>(i) * bits / flips, next = static_cast<std::size_t>(i + 1) * bits / flips;
    const std::size_t bit = part + uniform_below({3, 0, stream_id("stiff flip")}, static_cast<std::uint64_t>(i),
                                                 std::max<std::size_t>(1, next - part));
    std::string bad = good;
    bad[bit / 8] = static_cast<char>(bad[bit / 8] ^ (1 << (bit % 8)));
    accepted += refused_as_data(bad) ? 0 : 1;
  }
  run.measure(accepted, 0, "flips accepted");
  run.note(std::to_string(flips) + " flips over " + std::to_string(good.size()) +
           " bytes of a trained network's checkpoint");
}

void checkpoint_cuts(CaseRun& run) {
  run.row("-");
  const std::string good = small_checkpoint(run.registry());
  int accepted = 0;
  for (std::size_t i = 0; i < 1000; ++i) accepted += refused_as_data(good.substr(0, i * good.size() / 1000)) ? 0 : 1;
  accepted += refused_as_data(good.substr(0, good.size() - 1)) ? 0 : 1;
  accepted += refused_as_data(good + '\0') ? 0 : 1;
  run.measure(accepted, 0, "lengths accepted");
  // On the disk: the newest one cut short, the one before is found and the damage is reported.
  CheckpointStore store(run.folder() + "/c");
  save(store, 100);
  save(store, 200);
  const std::string newest = run.folder() + "/c/" + CheckpointStore::file_name(200);
  const std::string whole = read_text_file(newest);
  for (const std::size_t size :
       {whole.size() - 1, whole.size() / 2, std::size_t{300}, std::size_t{8}, std::size_t{0}}) {
    testing_room::plain_write(newest, whole.substr(0, size));
    Diagnostics found;
    const auto latest = store.find_latest(found);
    run.expect(latest && latest->step == 100 && latest->file.floats("w", 2000)[0] == 100.0F, "step 100 is used");
    run.expect(told(found, Severity::warning, CheckpointStore::file_name(200)), "and the damaged file named");
  }
  testing_room::plain_write(run.folder() + "/c/" + CheckpointStore::file_name(100), whole.substr(0, 40));
  run.expect_error(ErrorKind::data, {"none of the 2 checkpoints"}, [&] {
    Diagnostics found;
    (void)store.find_latest(found);
  });
}

void checkpoint_shapes(CaseRun& run) {
  run.row("-");
  TensorFile::Limits no_sums{.require_checksums = false};
  const auto decode = [&](const std::string& file) { (void)TensorFile::decode(file, "hostile.safetensors", no_sums); };
  decode(with_header(R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}})", 8));  // the control
  const struct {
    std::string header;
    std::size_t data;
    const char* words;
  } kHostile[] = {
      {R"({"a":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}})", 0,
       "product of its shape overflows"},
      {R"({"a":{"dtype":"F32","shape":[4611686018427387904,4],"data_offsets":[0,0]}})", 0,
       "product of its shape overflows"},
      {R"({"a":{"dtype":"F32","shape":[9223372036854775808],"data_offsets":[0,0]}})", 0, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[0,9223372036854775807,9223372036854775807],"data_offsets":[0,0]}})", 0,
       "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1152921504606846976],"data_offsets":[0,4611686018427387904]}})", 0, "cut short"},
      {R"({"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[2],"data_offsets":[4,12]}})",
       12, "overlapping"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"b":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}})",
       12, "a hole after byte 4"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}})", 8, "a hole after byte 0"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]},"a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]}})",
       8, "'a' occurs twice"},
      {R"({"a":{"dtype":"F32","dtype":"F64","shape":[1],"data_offsets":[0,4]}})", 4, "'dtype' occurs twice"},
      {R"({"a":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}})", 4, "dtype 'BF16'"},
      {R"({"a":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1e0],"data_offsets":[0,4]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[4,0]}})", 4, "do not hold"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,9223372036854775808]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":["x",0]}})", 4, "not a count"},
      {R"({"a":{"dtype":"F32","shape":[3],"data_offsets":[0,8]}})", 8, "do not hold"},
      {R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})", 5, "1 bytes behind the last tensor"},
      {R"({"__metadata__":{"a":1}})", 0, "not a text"},
      {R"([])", 0, "not a JSON object"},
      {R"({"a":)", 0, "not JSON"},
      {std::string(1'000'000, '['), 0, "nested too deeply"},
  };
  for (const auto& bad : kHostile)
    run.expect_error(ErrorKind::data, {"hostile.safetensors", bad.words},
                     [&] { decode(with_header(bad.header, bad.data)); });
  // Nothing of a header whose names lie on the heap is destroyed twice on the way out.
  for (const char* offsets : {"[9223372036854775808,0]", "[0,null]", "[0,-1]", "[0.5,4]", "[[0],4]", "null"})
    run.expect_error(ErrorKind::data, {"hostile.safetensors", "data_offsets"}, [&] {
      decode(with_header(R"({"a name that lies on the heap, and not in the text itself":{"dtype":"F32","shape":[1],)"
                         R"("data_offsets":)" +
                             std::string(offsets) + "}}",
                         4));
    });
  const ResourceUse use;
  for (const std::uint64_t length :
       {std::uint64_t{100'000'001}, std::uint64_t{1} << 62, ~std::uint64_t{0}, std::uint64_t{99'000'000}}) {
    std::string file = with_header("{}", 0);
    std::memcpy(file.data(), &length, 8);
    run.expect_error(ErrorKind::data, {"header length", "exceeds"}, [&] { decode(file); });
  }
  run.expect(use.grown_mib() < 16, "a stated length allocates nothing");
  for (const float bad : {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()}) {
    const std::vector<float> values{0, bad};
    const std::string file = encode_safetensors({tensor_ref("w", {2}, values)}, {});
    run.expect_error(ErrorKind::data, {"tensor 'w' holds NaN or infinity"}, [&] { decode(file); });
    const std::vector<double> wide{static_cast<double>(bad)};
    run.expect_error(ErrorKind::data, {"tensor 'v' holds NaN or infinity"},
                     [&] { decode(encode_safetensors({tensor_ref("v", {1}, wide)}, {})); });
  }
  run.expect_error(ErrorKind::data, {"no checksum"},
                   [&] { (void)TensorFile::decode(with_header("{}", 0), "bare", {}); });
}

}  // namespace semfield::numerics
