// Loads the library of image_formats.h when it is first needed.
#include "core/companion.h"
#include "core/error.h"
#include "scene/image_formats.h"

namespace semfield {

#ifdef SEMFIELD_WITH_IMAGES

namespace {

const ImageFormats& load() {
  void* symbol = companion_symbol(SEMFIELD_IMAGES_LIBRARY, kImageFormatsSymbol, "images other than PNG cannot be read",
                                  "install Semfield again, or convert the images to PNG");
  return *reinterpret_cast<const ImageFormats* (*)()>(symbol)();
}

}  // namespace

bool images_available() { return true; }

const ImageFormats& image_formats() {
  static const ImageFormats& formats = load();  // tried again where it failed
  return formats;
}

#else

bool images_available() { return false; }

const ImageFormats& image_formats() {
  throw Error(ErrorKind::unavailable, "this build reads PNG images only",
              "build with -DSEMFIELD_WITH_IMAGES=ON, or pack the scene elsewhere");
}

#endif

}  // namespace semfield
