// `semfield export` and `semfield classes`: the program on a tiny room; what it wrote is compared with what it renders.
#include <cstdlib>

#include "classes/class_import.h"
#include "formats/image_io.h"
#include "labels/mask_outlines.h"
#include "system/files.h"
#include "tests/labels/reader_case.h"
#include "tests/program.h"
#include "tests/says.h"

namespace semfield {
namespace {

using namespace testing_labels;
using testing_program::Result;
using testing_program::semfield_run;
using testing_room::fresh_folder;

TEST(ExportVerb, EveryFormHoldsTheRenderedLabels) {
  const std::string folder = fresh_folder("t");
  testing_room::write_replica(folder + "/room", 5);
  // Labels by way of a reader: the class images under another name.
  std::filesystem::rename(folder + "/room/semantic_class", folder + "/predictions");
  write_file_atomic(
      folder + "/room.yaml",
      "include: " + std::string(SEMFIELD_SOURCE_DIR) +
          "/configs/parts/hash_room.yaml\n"
          "scene: {type: replica, root: room, train_step: 2, test_step: 2, test_offset: 1, labels: {from: "
          "{type: images, folder: predictions, pattern: 'semantic_class_{number}.png'}}}\n");
  const Result trained = semfield_run("train room.yaml --steps 20 --threads 1 --out run -q", folder);
  ASSERT_EQ(trained.code, 0) << trained.err;
  const Result render = semfield_run("render run --split test --out rendered -q", folder);
  ASSERT_EQ(render.code, 0) << render.err;
  const ClassTable table = ClassTable::load(folder + "/room/classes.yaml");
  for (const std::string format : {"coco", "coco_rle", "labelme"}) {
    const Result r = semfield_run("export run --split test --format " + format + " --out " + format + ".json", folder);
    ASSERT_EQ(r.code, 0) << r.err;
    EXPECT_EQ(r.out.find("export: frames=2 shapes="), 0u) << r.out;
    const std::string path = folder + "/" + format + ".json";
    const auto reader =
        format == "labelme" ? make_reader("labelme", "folder: " + path) : make_reader("coco", "file: " + path);
    for (const std::string name : {"rgb_1", "rgb_3"}) {
      const Image<std::uint16_t> ids = read_ids(folder + "/rendered/" + name + "_label.png");
      std::vector<std::int16_t> rendered;
      for (const std::uint16_t id : ids.pixels) rendered.push_back(static_cast<std::int16_t>(table.index_of(id)));
      EXPECT_EQ(read_labels(*reader, frame_of(name), table).hard, rendered) << format << " " << name;
    }
  }
  // A run that loads its images smaller: labels still have the size of the images, unless an option says otherwise.
  const std::string half = "export run --split test --set scene.load.downscale=2 ";
  for (const std::string size : {"stored", "trained"}) {
    const Result r = semfield_run(half + "--size " + size + " --out half.json", folder);
    ASSERT_EQ(r.code, 0) << r.err;
    const std::string json = read_text_file(folder + "/half.json");
    EXPECT_NE(json.find(size == "stored" ? R"("height":30,"id":1,"width":40)" : R"("height":15,"id":1,"width":20)"),
              std::string::npos)
        << json.substr(0, 200);
  }
  ASSERT_EQ(semfield_run(half + "--format png --out images", folder).code, 0);
  EXPECT_EQ(read_text_file(folder + "/images/classes.yaml"), table.to_yaml());
  for (const std::string name : {"rgb_1", "rgb_3"}) {
    const Image<std::uint16_t> ids = read_ids(folder + "/images/" + name + "_label.png"),
                               whole = read_ids(folder + "/rendered/" + name + "_label.png");
    ASSERT_EQ(ids.width_px, 40);
    ASSERT_EQ(ids.height_px, 30);
    int alike = 0;
    for (std::size_t i = 0; i < ids.pixels.size(); ++i) alike += ids.pixels[i] == whole.pixels[i];
    EXPECT_GT(alike, 40 * 30 * 8 / 10) << name << ": rendered at every second pixel, and brought to the others";
  }
  // No region of the exported labels is smaller than asked; large ones are tested in small_regions_test.cpp.
  const Result calm = semfield_run("export run --split test --min-area 30 --format coco --out calm.json", folder);
  ASSERT_EQ(calm.code, 0) << calm.err;
  EXPECT_NE(calm.err.find(" regions of fewer than 30 pixels took the class around them: "), std::string::npos)
      << calm.err;
  const auto coco = make_reader("coco", "file: " + folder + "/calm.json");
  for (const std::string name : {"rgb_1", "rgb_3"}) {
    const std::vector<std::int16_t> labels = read_labels(*coco, frame_of(name), table).hard;
    std::int64_t smallest = std::ssize(labels);
    for (const MaskRegion& region : mask_regions(labels, 40, 30)) smallest = std::min(smallest, region.area_px);
    EXPECT_GE(smallest, 30) << name;
  }
  EXPECT_EQ(semfield_run("export run --min-area -1 --out x.json", folder).err,
            "semfield: --min-area -1: expected 0 to 1000000000 [usage.value.invalid]\n");
  const Result wrong = semfield_run("export run --format coc --out x.json", folder);
  EXPECT_EQ(wrong.code, 2);
  EXPECT_EQ(
      wrong.err,
      "semfield: --format coc: expected coco, coco_rle, labelme or png; did you mean coco? [usage.value.invalid]\n");
  EXPECT_EQ(semfield_run("export none --out x.json", folder).code, 66);
}

TEST(ClassesVerb, ConvertsTables) {
  const std::string folder = fresh_folder("t");
  EXPECT_EQ(semfield_run("classes nyu40", folder).out, published_classes("nyu40").to_yaml());
  ASSERT_EQ(semfield_run("classes scannet20 --format cvat --out labelmap.txt", folder).code, 0);
  EXPECT_EQ(load_cvat_labelmap(folder + "/labelmap.txt").valid_count(), 20);
  EXPECT_EQ(semfield_run("classes labelmap.txt --format csv", folder).out.find("class_id,class\n0,void\n1,wall\n"), 0u);
  EXPECT_NE(semfield_run("classes nyu13 --colors semfield", folder).out, published_classes("nyu13").to_yaml());
  write_file_atomic(folder + "/l.tsv", std::string_view("id\traw_category\tnyu40id\n2\toffice chair\t5\n"));
  EXPECT_NE(semfield_run("classes l.tsv --ids nyu40", folder).out.find("{id: 5, name: \"chair\""), std::string::npos);
  EXPECT_NE(semfield_run("classes l.tsv", folder).out.find("{id: 2, name: \"office chair\""), std::string::npos);
  const Result wrong = semfield_run("classes nyu13 --ids nyu40", folder);
  EXPECT_EQ(wrong.code, 2);
  EXPECT_SAID(wrong.err, "usage.flag.conflict", "semfield: --ids nyu40", "'nyu13'", "scannetv2-labels.combined.tsv");
  EXPECT_EQ(semfield_run("classes nyu13 --format yml", folder).err,
            "semfield: --format yml: expected yaml, csv or cvat; did you mean yaml? [usage.value.invalid]\n");
  EXPECT_EQ(semfield_run("classes none.yaml", folder).code, 66);
}

}  // namespace
}  // namespace semfield
