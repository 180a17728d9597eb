// Dataset, by the name under which writers of plugins know it.
#pragma once

#include "scene/dataset.h"
