// ScanNet's label table: columns by name, maps, refusals.
#include "classes/scannet_labels.h"

#include <gtest/gtest.h>

#include "system/files.h"
#include "tests/scene/tiny_scene.h"

namespace semfield {
namespace {

using testing_room::error_of;
using testing_room::fresh_folder;

const std::string kHeader = "id\traw_category\tcount\tnyu40id\teigen13id\tnyu40class\teigen13class\n";

TEST(ScannetLabels, ColumnsAreFoundByName) {
  const std::string path = fresh_folder("t") + "/labels.tsv";
  write_file_atomic(path, kHeader + "1\twall\t8277\t1\t12\twall\tWall\r\n2\toffice \"chair\"\t4\t5\t4\tchair\tChair\n" +
                              "1163\tobject\t9\t\t\t\t\n");
  const std::vector<ScannetLabel> labels = read_scannet_tsv(path);
  ASSERT_EQ(labels.size(), 3u);
  EXPECT_EQ(labels[0].eigen13class, "Wall");
  EXPECT_EQ(labels[1].raw_category, "office \"chair\"");
  EXPECT_EQ(labels[1].nyu40class, "chair");
  EXPECT_EQ(nyu40_of_scannet(labels).at(2), 5);
  EXPECT_EQ(eigen13_of_scannet(labels).at(1), 12);
  EXPECT_EQ(nyu40_of_scannet(labels).at(1163), 0);
  write_file_atomic(path, std::string_view("nyu40id\traw_category\tid\n3\tcabinet\t7\n"));
  EXPECT_EQ(nyu40_of_scannet(read_scannet_tsv(path)).at(7), 3);
}

TEST(ScannetLabels, RefusalsNameLineAndColumn) {
  const std::string path = fresh_folder("t") + "/labels.tsv";
  const auto read = [&](const std::string& text) {
    write_file_atomic(path, text);
    return error_of([&] { (void)read_scannet_tsv(path); });
  };
  const std::string give = "; give scannetv2-labels.combined.tsv: tab-separated, names of columns in the first line";
  const std::string restore = "; restore the table as ScanNet distributes it";
  EXPECT_EQ(read(""), path + ": no rows in it" + give);
  EXPECT_EQ(read("raw_category\tnyu40id\n"), path + ":1: no column 'id'" + give);
  EXPECT_EQ(read("id\traw_category\n"), path + ":1: neither a column 'nyu40id' nor a column 'eigen13id'" + give);
  EXPECT_EQ(read(kHeader + "1\twall\n"), path + ":2: 2 columns, the first line names 7" + give);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t41\t1\ta\tb\n"),
            path + ":2: nyu40id: expected a number from 0 to 40, got '41'" + restore);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t4\tx\ta\tb\n"),
            path + ":2: eigen13id: expected a number from 0 to 13, got 'x'" + restore);
  EXPECT_EQ(read(kHeader + "\twall\t1\t4\t1\ta\tb\n"), path + ":2: the row has no id" + give);
  EXPECT_EQ(read(kHeader + "1\twall\t1\t1\t12\ta\tb\n1\tdoor\t1\t8\t12\ta\tb\n"),
            path + ":3: id 1 ('door') is given before ('wall') with another class" + give);
  EXPECT_NE(error_of([&] { (void)read_scannet_tsv(path + "x"); }).find("cannot open"), std::string::npos);
}

}  // namespace
}  // namespace semfield
